"""The report: what it holds, and that a browser shows it, sorts it and plays it."""

import html
import json
import re
import shlex
import shutil
import subprocess

import numpy as np
import pytest

from coloc_env import make_scenario
from training.evaluation import runs
from training.evaluation.ellipsoids import half_axes
from training.evaluation.evaluate import evaluate
from training.evaluation.report.content import command, content, worst
from training.evaluation.report.page import page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="module")
def evaluation():
    scenario = make_scenario("indoor-v0", horizon=40, nlos=0.1, landmarks=8)
    return evaluate(scenario, ["dead_reckoning", "ekf"], 2, seed=5)


@pytest.fixture
def folder(evaluation, tmp_path):
    runs.write(runs.of(evaluation, "first"), tmp_path)
    (tmp_path / "results.json").write_text(json.dumps(evaluation.summary), "utf-8")
    return tmp_path


def test_runs_come_back_as_they_were(evaluation, folder) -> None:
    made, read = runs.of(evaluation, folder.name), runs.read(folder)
    assert (read.name, read.dt, read.low, read.high) == (made.name, made.dt, made.low, made.high)
    for name in ("truth", "scored", "links", "bound"):
        np.testing.assert_array_equal(
            getattr(read, name), getattr(made, name).astype(getattr(read, name).dtype)
        )
    for agent, one in made.methods.items():
        for name in ("error", "nees", "offset", "covariance"):
            np.testing.assert_array_equal(getattr(read.methods[agent], name), getattr(one, name))
    assert read.places["landmarks"].shape == (8, 3)
    assert read.links.shape == (40, 6, 6)
    assert not read.links[:, range(6), range(6)].any()


def test_nees_follows_from_what_is_kept(evaluation) -> None:
    """Covariances and errors of the first run belong together."""
    one = runs.of(evaluation, "x").methods["ekf"]
    solved = np.linalg.solve(one.covariance.astype(float), one.offset[..., None].astype(float))
    nees = (one.offset[..., None] * solved).sum((-2, -1))
    np.testing.assert_allclose(nees, one.nees[0], rtol=1e-3)


def test_damaged_files_are_refused_in_one_line(folder, tmp_path_factory) -> None:
    whole = (folder / runs.FILE).read_bytes()
    for cut in (0, 7, 300, len(whole) - 1):
        (folder / runs.FILE).write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"runs\.safetensors") as caught:
            runs.read(folder)
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"no results\.json"):
        runs.read(tmp_path_factory.mktemp("empty"))


def test_worst_moments_are_the_largest_errors(evaluation) -> None:
    made = runs.of(evaluation, "x")
    one = made.methods["ekf"]
    found = worst(made, "ekf", one)
    assert found[0]["error"] == pytest.approx(one.error.max())
    where = one.error[found[0]["run"], found[0]["step"], found[0]["uav"]]
    assert where == pytest.approx(found[0]["error"])
    assert found[0]["seed"] == 5 + found[0]["run"]
    assert [m["error"] for m in found] == sorted((m["error"] for m in found), reverse=True)
    assert len({(m["run"], m["uav"]) for m in found}) == len(found)  # within 5 s: one each


def test_ellipsoids_hold_what_they_say() -> None:
    """Of a Gaussian, 95 % lies within."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    axes = half_axes(root @ root.T)
    points = rng.normal(size=(20000, 3)) @ root.T
    inside = (np.linalg.solve(axes, points.T) ** 2).sum(0) <= 1
    assert inside.mean() == pytest.approx(0.95, abs=0.01)


def test_the_command_repeats_the_evaluation(evaluation) -> None:
    assert command(runs.of(evaluation, "x")) == (
        "coloc evaluate indoor-v0 --agents dead_reckoning,ekf --runs 2 --seed 5 "
        "--set horizon=40 --set nlos=0.1 --set landmarks=8 --out x"
    )
    odd = "a b; <c>"  # as a shell reads it
    assert shlex.split(command(runs.of(evaluation, odd)))[-2:] == ["--out", odd]


def test_two_of_one_name_are_refused(evaluation) -> None:
    made = runs.of(evaluation, "x")
    with pytest.raises(ValueError, match="two evaluations are named 'x'"):
        content([made, made])


def test_names_cannot_end_the_script(evaluation) -> None:
    text = page([runs.of(evaluation, "</script><script>alert(1)")])
    assert "<script>alert(1)" not in text


_USER = """
<script>
const wrong = [];
addEventListener("error", e => wrong.push(String(e.message)));
addEventListener("unhandledrejection", e => wrong.push(String(e.reason)));
</script>
"""
_CLICKS = """
<script>
setTimeout(() => {
  const all = selector => [...document.querySelectorAll(selector)];
  const button = (selector, text) => all(selector).find(b => b.textContent === text);
  const cells = () => all("#summary tbody tr td.name").map(c => c.textContent);
  const rmse = button("#summary th button", "RMSE");
  rmse.click(); const up = cells(); rmse.click(); const down = cells();
  const slider = document.querySelector("input[type=range]");
  slider.value = slider.max; slider.dispatchEvent(new Event("input"));
  const clock = document.querySelector("output").textContent;
  const player = document.querySelector(".player .plot");
  const truth = player.data.find(t => t.name === "truth");
  button("button", "show").click();
  const hide = button("#summary td button", "dead_reckoning");
  const before = document.querySelector(".plot").data.length; hide.click();
  const after = document.querySelector(".plot").data.length;
  const found = { wrong, up, down, clock, x: truth.x, ready: document.body.dataset.ready,
    before, after, plots: all(".plot .main-svg").length };
  const note = document.createElement("pre");
  note.id = "found";
  note.textContent = JSON.stringify(found);
  document.body.append(note);
}, 3000);
</script>
"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_browser_shows_it(evaluation, tmp_path) -> None:
    made = runs.of(evaluation, "first")
    text = page([made])
    assert "http" not in re.sub(r"<script>.*?</script>", "", text, count=1, flags=re.DOTALL)
    file = tmp_path / "report.html"
    file.write_text(
        text.replace("</head>", _USER + "</head>").replace("</body>", _CLICKS + "</body>"), "utf-8"
    )
    done = subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
            "--no-first-run", "--disable-background-networking", "--disable-component-update",
            "--disable-sync", "--enable-unsafe-swiftshader",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--virtual-time-budget=20000", "--dump-dom", file.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    written = re.search(r'<pre id="found">(.*?)</pre>', done.stdout)
    assert written, done.stderr[-2000:]
    found = json.loads(html.unescape(written.group(1)))
    assert found["wrong"] == []
    assert found["ready"] == "yes"
    assert found["up"] == ["bound", "ekf", "dead_reckoning"]
    assert found["down"] == found["up"][::-1]
    assert found["clock"] == "3.9 s"
    np.testing.assert_allclose(found["x"], made.truth[-1, :, 0], rtol=1e-5)
    assert found["before"] - found["after"] == 1
    assert found["plots"] >= 4
