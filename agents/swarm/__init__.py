"""Localization of whole swarms from ranges: multidimensional scaling and its relatives.

Functions here work on a team at once: positions [B, N, d] and symmetric matrices [B, N, N] of what
was measured between its members. Every link has one weight, so that an estimate depends on the
UAV's own links and, through them, on its connected component of the network.
"""
