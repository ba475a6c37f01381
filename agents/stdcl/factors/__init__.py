"""Learned factors of ranges: what a graph network says about ``map``'s Gaussian sites."""
