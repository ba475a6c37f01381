"""Which landmark is seen, where measurements do not say: data association for every filter."""

from agents.association.candidates import Candidates
from agents.association.naming import Association, AssociationName, associated

__all__ = ["Association", "AssociationName", "Candidates", "associated"]
