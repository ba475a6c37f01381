"""Checkpoints: what is written is read back, and whatever is wrong with one is said in a line."""

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from agents import make
from agents.particle.corrector import WeightCorrector
from agents.stdcl.network import StGnn
from agents.weights import Learned, learned, load, shipped, write
from coloc_env.scenarios import make_scenario
from training.evaluation.evaluate import split_agents


class Other(Learned):
    kind = "other"
    features = WeightCorrector.features


class Seeing(WeightCorrector):
    features = ("dx", "dy", "dz", "range")


class Wider(WeightCorrector):
    def __init__(self) -> None:
        super().__init__()
        self.out = nn.Linear(13, 1)


class Deeper(WeightCorrector):
    def __init__(self) -> None:
        super().__init__()
        self.more = nn.Linear(1, 1)


@pytest.fixture
def corrector() -> WeightCorrector:
    torch.manual_seed(1)
    return WeightCorrector()


@pytest.fixture
def file(corrector: WeightCorrector, tmp_path: Path) -> Path:
    write(tmp_path / "mine.safetensors", corrector, {"command": "none"})
    return tmp_path / "mine.safetensors"


def refused(source: str | Path, module: Learned) -> str:
    before = {name: value.clone() for name, value in module.state_dict().items()}
    with pytest.raises(ValueError, match=r".") as error:
        load(source, module)
    for name, value in module.state_dict().items():
        assert torch.equal(value, before[name]), "written to before it was checked"
    text = str(error.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("ending", ["mine.safetensors", "mine"])
def test_weights_come_back(corrector: WeightCorrector, file: Path, ending: str) -> None:
    other = WeightCorrector()
    weight = other.hidden.weight
    card = load(file.parent / ending, other)
    assert card["command"] == "none"
    assert other.hidden.weight is weight, "in place: a filter that uses it sees the change"
    for name, value in corrector.state_dict().items():
        assert torch.equal(value, other.state_dict()[name])


def test_figures_that_do_not_apply_are_null(corrector: WeightCorrector, file: Path) -> None:
    write(file, corrector, {"metrics": {"a": float("nan"), "b": 1.5}, "scores": {"c": [1e999]}})
    card = load(file, corrector)
    assert card["metrics"] == {"a": None, "b": 1.5}
    assert card["scores"] == {"c": [None]}


def test_every_shipped_checkpoint_says_how_it_was_trained() -> None:
    for name in shipped():
        folder = Path(__file__).parents[2] / "checkpoints"
        card = json.loads((folder / f"{name}.json").read_text())
        assert {"command", "options", "versions", "scores"} <= card.keys()
        assert card["command"].startswith("coloc train ")
        assert " /" not in card["command"], "a card names no folder of the machine it was made on"


def test_shipped_by_name() -> None:
    assert load("pfnn", WeightCorrector())["kind"] == "pfnn"


def test_missing(file: Path, corrector: WeightCorrector) -> None:
    text = refused("pfn", corrector)
    assert "did you mean 'pfnn'" in text
    assert "./pfn.safetensors" in text
    assert "none.safetensors: no such file" in refused(file.parent / "none", corrector)
    file.with_suffix(".json").unlink()
    assert "lacks its card mine.json" in refused(file, corrector)


@pytest.mark.parametrize("how", ["truncated", "corrupted", "empty", "another's"])
def test_damaged(file: Path, corrector: WeightCorrector, how: str) -> None:
    data = file.read_bytes()
    damaged = {
        "truncated": data[:-7],
        "corrupted": data[:-7] + bytes([data[-7] ^ 1]) + data[-6:],
        "empty": b"",
        "another's": data.replace(b"F32", b"I32"),
    }[how]
    file.write_bytes(damaged)
    text = refused(file, corrector)
    assert str(file) in text
    assert "damaged" in text


@pytest.mark.parametrize("text", ["", "{", "[]", '{"kind": "pfnn"}', '{"kind": 1, "features": 2}'])
def test_card_of_something_else(file: Path, corrector: WeightCorrector, text: str) -> None:
    file.with_suffix(".json").write_text(text)
    assert "mine.json" in refused(file, corrector)


def test_foreign(file: Path) -> None:
    assert "'pfnn': 'other' is needed" in refused(file, Other())
    text = refused(file, Seeing())
    assert "features dx, dy, dz, dvx, dvy, dvz" in text
    assert "dx, dy, dz, range are needed" in text


def test_other_shapes_and_numbers(file: Path, corrector: WeightCorrector) -> None:
    wider = refused(file, Wider())
    assert "out.weight is float32 [1, 12], float32 [1, 13] is needed" in wider
    assert "more.weight" in refused(file, Deeper())
    with torch.no_grad():
        corrector.out.bias.fill_(float("nan"))
    write(file, corrector, {})
    assert "out.bias holds NaN" in refused(file, WeightCorrector())
    write(file, corrector.double(), {})
    assert "float64 [12, 6], float32 [12, 6] is needed" in refused(file, WeightCorrector())


def test_a_pickle_is_not_opened(file: Path, corrector: WeightCorrector) -> None:
    torch.save(corrector.state_dict(), file)
    assert "damaged" in refused(file, corrector)
    card = json.loads(file.with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    file.with_suffix(".json").write_text(json.dumps(card))
    assert "not a safetensors file" in refused(file, corrector)


def test_nothing_half_written(
    file: Path, corrector: WeightCorrector, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in file.parent.iterdir()}
    with pytest.raises(TypeError):
        write(file, corrector, {"scores": object()})
    save_file({"a": torch.zeros(1)}, file.parent / "b.safetensors")
    (file.parent / "b.safetensors").unlink()
    assert {path.name: path.read_bytes() for path in file.parent.iterdir()} == before


# ---------------------------------------------------------------- doors


def test_a_byte_order_mark_is_read_over(file: Path) -> None:
    card = file.with_suffix(".json")
    card.write_bytes(b"\xef\xbb\xbf" + card.read_bytes())
    load(file, WeightCorrector())


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("features", ["dx", 1], "'features' is ['dx', 1], a list of names is needed"),
        ("epochs", 0, "'epochs' is 0, a whole number ≥ 1 is needed"),
        ("epochs", True, "'epochs' is True, a whole number ≥ 1 is needed"),
        ("metrics", {"rmse": "0.1"}, "'metrics' is {'rmse': '0.1'}, an object, each of its values"),
        ("metrics", {"rmse": float("nan")}, "is not JSON: NaN is not a finite number"),
        ("architecture", {"width": 3}, "has an architecture that no pfnn has: 'width'"),
    ],
)
def test_a_card_with_a_wrong_field(file: Path, key: str, value: object, words: str) -> None:
    card = file.with_suffix(".json")
    card.write_text(json.dumps(json.loads(card.read_text()) | {key: value}))
    with pytest.raises(ValueError, match=r".") as error:
        learned(WeightCorrector, file)
    assert words in str(error.value)


@pytest.mark.parametrize("value", [0, -1, 10**9, 64.0, True, "64", None, [], 10**400])
def test_an_architecture_of_another_size_is_refused_before_it_fills_the_memory(
    value: object, tmp_path: Path
) -> None:
    file = tmp_path / "net.safetensors"
    write(file, StGnn(width=8), {})
    assert learned(StGnn, file).architecture["width"] == 8
    card = json.loads(file.with_suffix(".json").read_text())
    card["architecture"]["width"] = value
    file.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(ValueError, match=r"net.safetensors") as error:
        learned(StGnn, file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["mappo", "stdcl", "pfnn"])
def test_damaged_cards(name: str, tmp_path: Path, damaged: Callable[..., Iterator[bytes]]) -> None:
    """One line, or the same weights as before: where what was damaged is not of the network."""
    root = Path(__file__).parents[2] / "checkpoints"
    file, card = tmp_path / f"{name}.safetensors", tmp_path / f"{name}.json"
    file.write_bytes((root / file.name).read_bytes())
    text = (root / card.name).read_text()
    whole, scenario = json.loads(text), make_scenario(SCENARIOS_OF[name])
    whole.get("architecture", {}).get("mode", {}).pop("feedback", None)
    of_network = ("kind", "features", "sha256", "architecture")
    lines = []
    for data in damaged(text, 0, 150):
        card.write_bytes(data)
        try:
            make(name, scenario, weights=str(file))
        except (ValueError, OSError) as error:
            lines.append(str(error))
        else:
            found = json.loads(data.decode("utf-8-sig"))
            if name == "mappo":  # any share of feedback is as good as another
                assert 0 <= found["architecture"]["mode"].pop("feedback") <= 1
            assert all(found.get(key) == whole.get(key) for key in of_network)
    assert len(lines) > 75
    assert not any("\n" in line for line in lines)
    assert all(line.encode() for line in lines)


SCENARIOS_OF = {"mappo": "indoor-v0", "stdcl": "swarm-v0", "pfnn": "indoor-v0"}


def test_paths_with_colons_commas_and_home(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    folder = tmp_path / "a:b, c~d"
    folder.mkdir()
    for end in (".safetensors", ".json"):
        (folder / f"my,net:1{end}").write_bytes(file.with_suffix(end).read_bytes())
    make(f"pfnn:weights={folder}/my,net:1.safetensors:correction=0.1,0.9", scenario)
    agent = f"pfnn:weights={folder}/my,net:1.safetensors:correction=0.1,0.9"
    names = ["ekf", agent, "apf:bounds=1,8", "ekf:robust=huber"]
    assert split_agents(",".join(names)) == names
    odd = tmp_path / "a:b=c, d=e"
    folder.rename(odd)
    names[1] = f"pfnn:weights={odd}/my,net:1.safetensors:correction=0.1,0.9"
    make(names[1], scenario)
    assert split_agents(",".join(names)) == names
    with pytest.raises(ValueError, match="unknown option 'corection'"):
        make("pfnn:weights=pfnn:corection=0.1,0.9", scenario)
    folder = odd
    monkeypatch.setenv("HOME", str(tmp_path))
    load("~/mine.safetensors", WeightCorrector())
    make("pfnn:weights=~/mine.safetensors", scenario)
    assert "there is no such home directory" in refused(
        "~nobody-here/a.safetensors", WeightCorrector()
    )
