"""Localizers as policies of the environment, teams of several, and policies that were learned."""
