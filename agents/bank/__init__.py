"""Banks: a learned branch that speaks only while it predicts better than a classical one."""

from agents.bank.bank import Bank, BankBelief, learned_branch
from agents.bank.evidence import BankOptions
from agents.bank.trial import Trial

__all__ = ["Bank", "BankBelief", "BankOptions", "Trial", "learned_branch"]
