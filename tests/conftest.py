"""For every test: one thread, and studies that take minutes only when asked for."""

import os

# MKL's products of matrices, and with them the last digits of a row of a batch, then do not depend
# on where in memory the row lies. It has to be said before MKL is first used.
os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")

import pytest
import torch


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.option.markexpr:
        return
    skip = pytest.mark.skip(reason="slow: run with `pytest -m slow`")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)
