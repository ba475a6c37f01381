"""Making localizers by name: what is there, and one clear line for what is not."""

import importlib
import inspect
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
from torch import Tensor

from agents import LOCALIZERS, Localizer, make
from agents.kalman.ekf import CooperativeEkf
from agents.robust import RobustScreen
from coloc_env.registry import Registry
from coloc_env.scenario import Believed, Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Sensor
from coloc_env.sensors.base import Layout, Leaf, Window


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return make_scenario("indoor-v0", n_uavs=2, anchors=4)


@pytest.mark.parametrize("name", LOCALIZERS)
def test_every_name_makes_a_localizer_from_beliefs_alone(name: str, tools: SimpleNamespace) -> None:
    scenario = tools.room(name)
    localizer = make(name, scenario)
    assert isinstance(localizer, Localizer)
    assert localizer.believed is scenario.believed
    assert all(
        option.default is not inspect.Parameter.empty
        for option in LOCALIZERS.options_of(name).values()
    )


def test_options_come_by_keyword_or_in_the_name(scenario: Scenario) -> None:
    by_name = make("ekf:robust=huber:iterations=3:cooperate=false", scenario)
    by_key = make("ekf", scenario, robust="huber", iterations=3, cooperate=False)
    for localizer in (by_name, by_key):
        assert isinstance(localizer, CooperativeEkf)
        assert isinstance(localizer.screen, RobustScreen)
        assert (localizer.screen.methods, localizer.iterations) == ({"huber"}, 3)
        assert not any(model.cooperative for model in localizer.models)
    assert make("pf800:particles=1000", scenario).particles == 1000  # type: ignore[attr-defined]


REFUSALS = {
    "ekff": ["unknown agent 'ekff'", "did you mean 'ekf'", *LOCALIZERS],
    "": ["unknown agent ''", *LOCALIZERS],
    " ekf": ["unknown agent ' ekf'"],
    "EKF": ["unknown agent 'EKF'"],
    "ekf:robst=huber": ["ekf", "unknown option 'robst'", "did you mean 'robust'", "iterations"],
    "ekf:robust=hubert": [
        "ekf",
        "robust='hubert'",
        "none, or some of huber, student, mixture, gate, ransac, temporal, cross joined by +",
    ],
    "ekf:iterations=two": ["ekf", "iterations='two'", "a whole number"],
    "ekf:iterations=2.5": ["ekf", "iterations='2.5'", "a whole number"],
    "ekf:iterations=0": ["ekf", "iterations='0'", "a whole number ≥ 1"],
    "ekf:iterations=-3": ["ekf", "iterations='-3'", "a whole number ≥ 1"],
    "ekf:gate=1": ["ekf", "gate='1'", "a number > 0 and < 1"],
    "ekf:gate=nan": ["ekf", "gate='nan'", "a number"],
    "ekf:cooperate=perhaps": ["ekf", "cooperate='perhaps'", "true or false"],
    "ekf:fusion=CI": ["ekf", "fusion='CI'", "one of naive, ci"],
    "ekf:robust": ["ekf", "option 'robust'", "key=value"],
    "ekf:": ["ekf", "option ''", "key=value"],
    "ekf::robust=huber": ["ekf", "option ''", "key=value"],
    "ekf:=huber": ["ekf", "unknown option ''", "robust"],
    "ekf:robust=": [
        "ekf",
        "robust=''",
        "none, or some of huber, student, mixture, gate, ransac, temporal, cross joined by +",
    ],
    "ekf:robust=huber=gate": ["ekf", "robust='huber=gate'"],
    "ekf:robust=huber:robust=gate": ["ekf", "robust", "twice"],
    "dead_reckoning:robust=huber": ["dead_reckoning", "unknown option 'robust'", "none"],
    "ekf_joint:gate=0": ["ekf_joint", "gate='0'", "a number > 0 and < 1"],
    "ekf_joint:iterations=0": ["ekf_joint", "iterations='0'", "a whole number ≥ 1"],
    "pf800:particles=9": ["pf800", "particles='9'", "a whole number from 10 to 100000"],
    "pf500:perturb=liuwest": ["pf500", "perturb='liuwest'", "one of liu_west, fixed"],
    "pf500:seed=1e3": ["pf500", "seed='1e3'", "a whole number"],
    "pf500:seed=-1": ["pf500", "seed='-1'", "a whole number ≥ 0"],
    "pf500:particles=1000000000": ["pf500", "particles=", "from 10 to 100000"],
    "apf:bounds=5,400": ["apf", "bounds=", "from 10 to 100000"],
    "apf:bounds=400,500": ["apf", "bounds=(400, 500)", "low ≤ particles (300) ≤ high"],
    "pfnn:correction=0,1": ["pfnn", "correction=", "> 0"],
    "pfnn:correction=0.9,0.5": ["pfnn", "correction=(0.9, 0.5)", "low ≤ high"],
    "ekf_trust:iterations=0": ["ekf_trust", "iterations='0'", "a whole number ≥ 1"],
    "emvf:memory=1": ["emvf", "memory='1'", "from 2 to 1000 in steps"],
    "hpff:quantile=1": ["hpff", "quantile='1'", "a number > 0 and < 1"],
    "hpff:quantile=1.5": ["hpff", "quantile='1.5'", "a number > 0 and < 1"],
    "hpff:patience=0": ["hpff", "patience='0'", "a whole number ≥ 1"],
    "nnhpff:threshold=-0.1": ["nnhpff", "threshold='-0.1'", "from 0 to 1"],
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_does_not_fit_is_refused_in_one_line(name: str, scenario: Scenario) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        make(name, scenario)
    text = str(caught.value)
    assert "\n" not in text
    for part in REFUSALS[name]:
        assert part in text, f"{part!r} is not in {text!r}"


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"robust": "hubert"}, ["ekf", "robust='hubert'", "huber"]),
        ({"robust": None}, ["ekf", "robust=None"]),
        ({"iterations": "2"}, ["ekf", "iterations='2'", "a whole number"]),
        ({"iterations": True}, ["ekf", "iterations=True", "a whole number"]),
        ({"cooperate": 1}, ["ekf", "cooperate=1", "true or false"]),
        ({"gate": float("nan")}, ["ekf", "gate=nan", "a number"]),
        ({"believed": None}, ["ekf", "unknown option 'believed'"]),
    ],
)
def test_keywords_are_checked_like_the_name(
    options: dict, parts: list[str], scenario: Scenario
) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        make("ekf", scenario, **options)
    assert all(part in str(caught.value) for part in parts), caught.value


def test_an_option_is_given_once(scenario: Scenario) -> None:
    with pytest.raises(ValueError, match=r"^ekf: robust is given twice"):
        make("ekf:robust=huber", scenario, robust="gate")


SHORTCOMINGS: dict[str, tuple[str, dict, str]] = {
    "too many UAVs": ("ekf_joint", {"n_uavs": 20}, "max_neighbours"),
    "no attitude": ("ekf", {"imu": False}, "attitude"),
    "no attitude, joint": ("ekf_joint", {"imu": False}, "attitude"),
    "no attitude, particles": ("pf500", {"imu": False}, "attitude"),
    "no anchors": ("hpff", {}, "no distances to anchors"),
}


@pytest.mark.parametrize("case", SHORTCOMINGS)
def test_a_scenario_that_does_not_suit_is_refused_when_made(case: str) -> None:
    name, overrides, word = SHORTCOMINGS[case]
    scenario = make_scenario("indoor-v0", **overrides)
    with pytest.raises(ValueError, match=rf"^{name}: .*{word}"):
        make(name, scenario)


def test_register_adds_a_name(scenario: Scenario) -> None:
    @LOCALIZERS.register("half")
    def half(believed: Believed, *, share: float = 0.5) -> Localizer:
        """Half a filter."""
        if share > 1:
            raise ValueError("more than all")
        return CooperativeEkf(believed)

    try:
        assert "half" in list(LOCALIZERS)
        assert LOCALIZERS.summary("half") == "Half a filter."
        assert isinstance(make("half:share=0.25", scenario), CooperativeEkf)
        with pytest.raises(ValueError, match=r"^half: more than all$"):
            make("half:share=2", scenario)
    finally:
        LOCALIZERS.remove("half")
    assert "half" not in LOCALIZERS


def test_a_built_in_name_stays(scenario: Scenario) -> None:
    with pytest.raises(ValueError, match="agent 'ekf' exists already"):
        LOCALIZERS.register("ekf")


@pytest.mark.parametrize("name", LOCALIZERS)
def test_summaries_are_those_of_the_docstrings(name: str) -> None:
    """Read from the source, before anything is imported."""
    module, _, attribute = LOCALIZERS._references[name].partition(":")
    doc = getattr(importlib.import_module(module), attribute).__doc__
    assert Registry("agent", "none", {name: f"{module}:{attribute}"}).summary(name) in (
        " ".join(doc.replace("``", "").split())
    )


IGNORED = {  # a localizer, a scenario, and what it would ignore of it
    "stdcl indoors": ("stdcl", "indoor-v0", {}, "Landmarks"),
    "map indoors": ("map", "indoor-v0", {}, "Landmarks"),
    "dwmds_st indoors": ("dwmds_st", "indoor-v0", {}, "Landmarks"),
    "ekf among relative poses": ("ekf", "stein2d-v0", {}, "RelativePose"),
    "cspf in a swarm": ("cspf", "swarm-v0", {}, "PositionFix, Ranging"),
    "emvf by ranges between UAVs": ("emvf", "indoor-v0", {"landmarks": 0}, "Ranging"),
    "a hybrid of what ignores it": ("hpff:main=map", "indoor-v0", {"anchors": 4}, "Landmarks"),
}


@pytest.mark.parametrize("case", IGNORED)
def test_a_localizer_refuses_to_ignore_what_is_measured(case: str) -> None:
    name, scenario, overrides, sensors = IGNORED[case]
    owner = name.split(":")[0]
    words = rf"^{owner}: .*{sensors} would be ignored; these use it: "
    with pytest.raises(ValueError, match=words):
        make(name, make_scenario(scenario, **overrides))


def test_nothing_to_estimate_from_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^emvf: the team measures nothing of its own"):
        make("emvf", make_scenario("indoor-v0", landmarks=0, uwb=False))


@dataclass(frozen=True)
class Barometer(Sensor):
    """A sensor that nobody has a measurement model for."""

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {}


class Sonar(Barometer):
    """Another."""


def test_a_sensor_without_a_model_is_named_once(
    scenario: Scenario, recwarn: pytest.WarningsRecorder
) -> None:
    def with_sensor(sensor: Sensor) -> Believed:
        believed = scenario.believed
        return replace(believed, sensors=(*believed.sensors, sensor))

    for name in ("ekf", "ekf", "pf500"):
        make(name, with_sensor(Barometer()))
    make("ekf", with_sensor(Sonar()))
    words = [str(w.message) for w in recwarn if issubclass(w.category, UserWarning)]
    assert [w.split()[0] for w in words] == ["Barometer", "Sonar"]
    assert all("has no measurement model" in w for w in words)
    with pytest.raises(ValueError, match=r"^map: .*Landmarks, Barometer would be ignored"):
        make("map", with_sensor(Barometer()))
