"""Which landmark is seen, where measurements do not say: data association for every filter."""

from agents.association.naming import METHODS, Association, AssociationName, associated

__all__ = ["METHODS", "Association", "AssociationName", "associated"]
