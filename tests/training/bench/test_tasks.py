"""What is timed where tasks are, and in which order."""

from collections.abc import Callable

from training.bench import tasks
from training.bench.cases import Case, Timed
from training.bench.rounds import rounds


def test_cases_count_agent_steps_and_are_run_in_turn() -> None:
    order: list[str] = []

    def waiting(name: str) -> Callable[[], Timed]:
        def run(steps: int) -> None:
            order.append(name)
            sum(range(20_000 * steps))

        return lambda: Timed(run)

    cases = [Case("few", "agents", 10, 10, waiting("few"))]
    cases.append(Case("many", "agents", 10_000, 10, waiting("many")))
    found = rounds(cases, range(4))
    assert order == ["few", "many"] * 4
    assert found["many agents"]["median"] > found["few agents"]["median"] > 0


def test_every_task_is_timed_in_both_ways_and_its_agents_counted() -> None:
    cases = {case.key: case for case in tasks.task_cases()}
    assert len(cases) == 2 * len(tasks.NAMES) + 1
    assert cases[f"schedule-v0 {tasks.FACE}"].agents == 6
    assert cases[f"schedule-v0 {tasks.BATCH}"].agents == 6 * tasks.WORLDS
    cases[f"schedule-v0 {tasks.FACE}"].setup().run(2)
