"""What became of the paper's claims in our runs."""

from training.reproduce.pfnn.claims_inside import inside
from training.reproduce.pfnn.claims_results import results
from training.reproduce.pfnn.flown import Case, Flown
from training.reproduce.verdicts import Verdict, decide


def verdicts(flown: Flown) -> list[Verdict]:
    """Every claim, decided; one whose agents were not flown is not measured."""
    return [_judged(case, flown) for case in (*results(), *inside())]


def _judged(case: Case, flown: Flown) -> Verdict:
    absent = [agent for agent in case.needs if agent not in flown.tables.agents]
    if absent:
        return decide(case.claim, None, f"not flown: {', '.join(absent)}")
    return decide(case.claim, case.figure(flown))
