"""What is installed: wheel and sdist, and an environment in which another package has our names."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

from coloc_env._command import require_own_packages

ROOT = Path(__file__).parents[1]
COMMAND = "from coloc_env._command import main; main()"
PACKAGES = {"agents", "checkpoints", "coloc_env", "training"}


def python(code: str, *path: Path, argv: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Run code in a process of its own that sees these folders first, then this checkout."""
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (*path, ROOT)))}
    line = [sys.executable, "-c", code, *argv]
    return subprocess.run(line, env=environ, cwd=path[0], capture_output=True, text=True)


@pytest.fixture(params=["agents", "training"])
def foreign(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Another's package that has the name of one of ours."""
    init = tmp_path / request.param / "__init__.py"
    init.parent.mkdir()
    init.write_text('"""Somebody else\'s."""\n')
    return init


def test_our_own_packages_are_taken_for_ours() -> None:
    require_own_packages()


def test_the_command_names_a_package_that_hides_ours(foreign: Path, tmp_path: Path) -> None:
    found = python(COMMAND, tmp_path, argv=("--help",))
    assert found.returncode == 2
    assert found.stdout == ""
    assert len(found.stderr.splitlines()) == 1
    assert str(foreign) in found.stderr
    assert "environment of its own" in found.stderr


def test_one_installed_on_top_of_ours_is_found_too(tmp_path: Path) -> None:
    """pip puts both into one folder: our modules are there, the package's face is another's."""
    folder = tmp_path / "agents"
    folder.mkdir()
    (folder / "__init__.py").write_text("from nowhere import Agent\n")
    (folder / "registry.py").write_text("")
    found = python(COMMAND, tmp_path)
    assert found.returncode == 2
    assert str(folder) in found.stderr


def test_importing_training_says_the_same(tmp_path: Path) -> None:
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").write_text("")
    found = python("import training.cli", tmp_path)
    assert found.returncode == 1
    last = found.stderr.splitlines()[-1]
    assert last.startswith("ImportError: the package 'agents' at")
    assert "environment of its own" in last


# ------------------------------------------------------------------ wheel and sdist


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sdist, and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("built")
    source = folder / "source"
    hidden = shutil.ignore_patterns(".*", "build", "dist", "site", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, source, ignore=hidden)
    line = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(source)]
    subprocess.run(line, check=True, capture_output=True)
    return folder


@pytest.mark.slow
def test_the_wheel_holds_packages_checkpoints_and_marks_and_no_tests(built: Path) -> None:
    (file,) = built.glob("coloc_env-*.whl")
    names = zipfile.ZipFile(file).namelist()
    top = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert top == PACKAGES
    assert {f"{package}/py.typed" for package in PACKAGES} <= set(names)
    for suffix in (".safetensors", ".json"):
        inside = {name for name in names if name.startswith("checkpoints/")}
        shipped = {f"checkpoints/{path.name}" for path in (ROOT / "checkpoints").glob(f"*{suffix}")}
        assert shipped
        assert shipped <= inside
    modules = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for path in ROOT.glob(f"{package}/**/*.py")
    }
    assert modules <= set(names)


@pytest.mark.slow
def test_the_sdist_holds_what_the_wheel_is_built_from(built: Path) -> None:
    (file,) = built.glob("coloc_env-*.tar.gz")
    with tarfile.open(file) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"LICENSE", "README.md", "pyproject.toml", "coloc_env/world.py"} <= names
    assert "checkpoints/pfnn.safetensors" in names


@pytest.mark.slow
def test_the_installed_wheel_runs(built: Path, tmp_path: Path) -> None:
    """In a new environment, with this one's packages for its dependencies."""
    (file,) = built.glob("coloc_env-*.whl")
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    binaries = tmp_path / "venv" / "bin"
    install = [binaries / "python", "-m", "pip", "install", "--quiet", "--no-deps", file]
    subprocess.run(install, check=True)
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    own = subprocess.run([binaries / "python", "-c", where], capture_output=True, text=True)
    (Path(own.stdout.strip()) / "outer.pth").write_text(sysconfig.get_path("purelib") + "\n")
    environ = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def coloc(*words: str) -> str:
        line = [binaries / "coloc", *words]
        found = subprocess.run(line, cwd=tmp_path, env=environ, capture_output=True, text=True)
        assert found.returncode == 0, found.stderr
        return found.stdout

    assert "coloc evaluate" in coloc("--help")
    words = "evaluate indoor-v0 --agents ekf,pfnn --runs 1 --no-figures --set horizon=20 --out out"
    coloc(*words.split())
    results = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))
    assert 0 < results["agents"]["pfnn"]["rmse"] < 2
