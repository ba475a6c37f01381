"""The store: nothing is lost, nothing is mixed; and what a result is said to depend on."""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from agents.localizer import Localizer
from agents.parts import parts_of
from agents.registry import make
from coloc_env.scenarios import make_scenario
from training import identity
from training.reproduce import work
from training.reproduce.store import Store
from training.reproduce.work import Piece, Variant

SETTINGS = {"agent": "ekf:robust=huber", "seed": 0, "overrides": {"room": (30.0, 20.0, 5.0)}}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def save(store: Store, settings: dict[str, object] = SETTINGS) -> Path:
    arrays = {"error": np.arange(6, dtype=np.float32).reshape(2, 3), "broken": np.array([True])}
    store.save("nlos/ekf:robust=huber-0+2", settings, arrays, {"raised": 1, "message": "a — b"})
    return store.path("nlos/ekf:robust=huber-0+2", settings)


def test_round_trip(store: Store) -> None:
    assert not store.has("nlos/ekf:robust=huber-0+2", SETTINGS)
    path = save(store)
    assert path.parent.name == "nlos"
    assert path.name.startswith("ekf_robust=huber-0+2-")
    assert store.has("nlos/ekf:robust=huber-0+2", SETTINGS)
    arrays, facts = store.load("nlos/ekf:robust=huber-0+2", SETTINGS)
    assert arrays.keys() == {"error", "broken"}
    assert arrays["error"].dtype == np.float32
    np.testing.assert_array_equal(arrays["error"], [[0, 1, 2], [3, 4, 5]])
    assert facts == {"raised": 1, "message": "a — b"}


@pytest.mark.parametrize("change", [{"seed": 1}, {"code": "abc"}, {"agent": "ekf"}])
def test_other_settings_are_another_piece(store: Store, change: dict[str, object]) -> None:
    path = save(store)
    other = SETTINGS | change
    assert not store.has("nlos/ekf:robust=huber-0+2", other)
    assert store.path("nlos/ekf:robust=huber-0+2", other) != path


def test_mixed_settings_are_refused(store: Store) -> None:
    other = SETTINGS | {"seed": 1}
    save(store).rename(store.path("nlos/ekf:robust=huber-0+2", other))
    with pytest.raises(ValueError, match="other settings"):
        store.load("nlos/ekf:robust=huber-0+2", other)


def _mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Bits flipped, a part cut off, doubled, zeroed or overwritten, or nothing left."""
    data, n = bytearray(content), len(content)
    a, b = sorted(rng.integers(0, n, 2).tolist())
    kind = rng.integers(7)
    if kind == 0:
        data[a] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del data[a:]
    elif kind == 2:
        del data[a : b + 1]
    elif kind == 3:
        data[b:b] = data[a : b + 1]
    elif kind == 4:
        data[a : b + 1] = bytes(b + 1 - a)
    elif kind == 5:
        size = min(64, n - a)
        data[a : a + size] = rng.bytes(size)
    else:
        return b"" if a % 2 else b"PK\x03\x04" + rng.bytes(50)
    return bytes(data)


def test_damaged_files_are_never_taken(store: Store) -> None:
    path, name = save(store), "nlos/ekf:robust=huber-0+2"
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(250):
        damaged = _mutated(whole, rng)
        if damaged == whole:
            continue
        path.write_bytes(damaged)
        assert not store.has(name, SETTINGS)  # so it is computed again
        with pytest.raises(ValueError, match=re.escape(f"{path.name} is damaged")) as error:
            store.load(name, SETTINGS)
        assert "\n" not in str(error.value)
    path.write_bytes(whole)
    assert store.has(name, SETTINGS)


def test_whoever_forges_a_checksum_gets_one_line(store: Store) -> None:
    path, name = save(store), "nlos/ekf:robust=huber-0+2"
    whole, rng = path.read_bytes()[:-32], np.random.default_rng(777)
    lines = []
    for _ in range(250):
        archive = _mutated(whole, rng)
        path.write_bytes(archive + hashlib.sha256(archive).digest())
        try:
            store.load(name, SETTINGS)
        except ValueError as error:
            lines.append(str(error))
    assert len(lines) > 200
    assert all(path.name in line and "\n" not in line for line in lines)


def test_numpy_reads_the_files_too(store: Store) -> None:
    with np.load(save(store)) as file:
        np.testing.assert_array_equal(file["error"], [[0, 1, 2], [3, 4, 5]])


def test_nothing_is_ever_half_written(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:100])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(KeyboardInterrupt):
        save(store)
    assert not store.has("nlos/ekf:robust=huber-0+2", SETTINGS)
    assert not store.folder.exists()


def closure(tmp_path: Path, text: str) -> str:
    identity._read.cache_clear()
    identity._closure.cache_clear()
    file = tmp_path / "agent.py"
    file.write_text(text)
    return identity._closure((file,))


def test_code_counts_and_words_do_not(tmp_path: Path) -> None:
    plain = closure(tmp_path, "def f(x):\n    return x + 1\n")
    worded = '"""A module."""\n\n\ndef f(x):\n    """Adds."""\n    return x + 1  # one\n'
    assert closure(tmp_path, worded) == plain
    assert closure(tmp_path, "def f(x):\n    return x + 2\n") != plain


def test_code_of_what_is_imported_counts(tmp_path: Path) -> None:
    alone = closure(tmp_path, "import math\n")
    assert closure(tmp_path, "import cmath\n") != alone
    code, imports = identity._read(Path(identity.__file__))
    names = {file.name for file in imports}
    assert "localizer.py" in names
    assert "torch" not in {file.parent.name for file in imports}
    assert "__init__.py" not in names  # agents and coloc_env only register
    assert "Hash of the code" not in code


def test_agents_share_no_more_than_they_use() -> None:
    room = make_scenario("indoor-v0", anchors=4)

    def code(agent: str, *modules: str) -> str:
        return identity.code_of("indoor-v0", [make(agent, room)], modules)

    assert code("ekf") == code("ekf:robust=huber")
    assert code("ekf") != code("pf500")
    assert code("ekf") != code("ekf", "training.learning.pfnn_online")
    assert code("hpff") != code("hpff:main=ekf")  # what it is made of counts
    assert code("hpff") == code("hpff:main=pf500")


INDOOR, SWARM = "coloc_env/scenarios/indoor.py", "coloc_env/scenarios/swarm.py"


@pytest.mark.parametrize(
    ("file", "scenario", "agent", "counts"),
    [
        (INDOOR, "indoor-v0", "ekf", True),
        (SWARM, "indoor-v0", "ekf", False),
        (INDOOR, "swarm-v0", "dwmds_st", False),
        (SWARM, "swarm-v0", "dwmds_st", True),
        ("coloc_env/world.py", "indoor-v0", "ekf", True),
        ("coloc_env/envs/sb3.py", "indoor-v0", "ekf", False),
        ("agents/kalman/ekf.py", "indoor-v0", "hpff:main=ekf", True),  # the main filter
        ("agents/kalman/emvf.py", "indoor-v0", "hpff:main=ekf", True),  # the auxiliary
        ("agents/kalman/ekf.py", "indoor-v0", "pf500", False),
        ("agents/policies/learned.py", "indoor-v0", "mappo", True),
        ("agents/kalman/ekf.py", "indoor-v0", "mappo", True),  # the policy's base
        (
            "agents/swarm/dwmds_st.py",
            "swarm-v0",
            "stdcl:variant=paper",
            True,
        ),  # the optimizer in the loop
        ("training/evaluation/record.py", "indoor-v0", "ekf", True),
        ("training/evaluation/figures.py", "indoor-v0", "ekf", False),
        ("training/reproduce/tables.py", "indoor-v0", "ekf", False),
    ],
)
def test_a_piece_depends_on_its_family_and_its_localizers(
    file: str, scenario: str, agent: str, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = (("anchors", 4),) if "hpff" in agent else ()
    piece = Piece(Variant("x", "x", overrides, scenario, steps=3), (agent,), 0, 1)
    work._settings.cache_clear()
    before = piece.settings()["code"]
    changed, read = Path(identity.__file__).parents[1] / file, identity._read

    def with_change(path: Path) -> tuple[str, tuple[Path, ...]]:
        code, imports = read(path)
        return code + ("CHANGED = 1" if path == changed else ""), imports

    monkeypatch.setattr(identity, "_read", with_change)
    for cache in (work._settings, identity._closure):
        cache.cache_clear()
    after = piece.settings()["code"]
    for cache in (work._settings, identity._closure):
        cache.cache_clear()
    assert (after != before) == counts


def learned(scale: float, nested: bool) -> Localizer:
    """A localizer with a network, or with one in a part of a part of it."""
    localizer = make("ekf", make_scenario("indoor-v0"))
    network = nn.Linear(2, 1)
    with torch.no_grad():
        network.weight.fill_(scale)
        network.bias.zero_()
    part = network
    if nested:
        part = make("ekf", make_scenario("indoor-v0"))
        part.parts = [{"network": network, "itself": part}]
    localizer.network = part
    return localizer


@pytest.mark.parametrize("nested", [False, True])
def test_weights(nested: bool) -> None:
    assert identity.weights_of(make("ekf", make_scenario("indoor-v0"))) is None
    one = identity.weights_of(learned(1.0, nested))
    assert one is not None
    assert identity.weights_of(learned(1.0, nested)) == one
    assert identity.weights_of(learned(2.0, nested)) != one


@pytest.mark.parametrize("agent", ["pfnn", "pf_trust", "ekf_trust"])
def test_weights_of_learned_agents(agent: str) -> None:
    scenario = make_scenario("indoor-v0")
    one = make(agent, scenario, weights="none")
    before = identity.weights_of(one)
    assert before is not None
    networks = [part for part in parts_of(one) if isinstance(part, nn.Module)]
    with torch.no_grad():
        next(networks[0].parameters()).add_(1.0)
    assert identity.weights_of(one) != before
