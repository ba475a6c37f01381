"""What is counted where tasks are timed."""

from training.bench import tasks


def test_blocks_count_agent_steps_and_are_run_in_turn() -> None:
    order: list[str] = []

    def block(name: str, count: int):
        def run() -> int:
            order.append(name)
            sum(range(200_000))
            return count

        return run

    found = tasks.measured({"few": block("few", 10), "many": block("many", 10_000)})
    assert order == ["few", "many"] * (1 + tasks.ROUNDS)
    assert found["many"] > found["few"] > 0
    assert tasks.one_world("schedule-v0")() == 6 * tasks.STEPS
