"""Localization of whole swarms from ranges: multidimensional scaling and its relatives.

Functions here work on a team at once: positions [B, N, d] and symmetric matrices [B, N, N] of what
was measured between its members. Every link has one weight, so what a UAV gets depends on its own
links and, through them, on the connected part of the network that it is in.
"""
