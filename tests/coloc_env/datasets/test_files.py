"""Reading text files: exact times, errors that name the line, the cache."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coloc_env.datasets import files, folders
from coloc_env.datasets.files import DataError, FileFormat, distinct, fail, read

SECONDS = FileFormat(("x", "n"), "seconds", whole=("n",))
NANOSECONDS = FileFormat(("x", "n"), "nanoseconds", ",", whole=("n",))
NAMED = FileFormat(("x", "n"), "relative seconds", ",", header=True, whole=("n",))
STAMPED = FileFormat(("x", "n"), "nanoseconds", ",", header=True, whole=("n",), stamp_column="at")
MARKED = FileFormat(("x", "n"), "relative seconds", whole=("n",), words=("b", "a"))
GOOD = {
    SECONDS: "# t x n\n1248444175.103 \t 2.5 \t 7\n\n1248444175.115  -1e-3  8\n1248444175.2 1 9\n",
    NANOSECONDS: "#t,x,n\n1403715273262142976,2.5,7\n1403715273262142977,-1e-3,8\n"
    "1403715273262142977,1,9\n",
    NAMED: 'n,text,timestamp,x\n7,"a, b",1e-09,2.5\n8,"[1 2\n 3]",1e-06,-1e-3\n9,c,1.5,1\n',
    STAMPED: "%time,n,at,x\n0,7,1.4e+18,2.5\n1,8,1.4037152732621426e+18,-1e-3\n"
    "2,9,1403715273262142977,1\n",
    MARKED: "# a or b\na 3 1\nb 0.5 2.5 7 \n\nb 1 -1e-3 8\na 2 1\nb 1.5 1 9\n",
}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write(folder: Path, text: str) -> Path:
    path = folder / "recorded.txt"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("form", "time"),
    [
        (SECONDS, [1248444175103000000, 1248444175115000000, 1248444175200000000]),
        (NANOSECONDS, [1403715273262142976, 1403715273262142977, 1403715273262142977]),
        (NAMED, [1, 1000, 1500000000]),
        (STAMPED, [1400000000000000000, 1403715273262142600, 1403715273262142977]),
        (MARKED, [500000000, 1000000000, 1500000000]),
    ],
)
def test_good_file(tmp_path: Path, form: FileFormat, time: list[int]) -> None:
    rows = read(write(tmp_path, GOOD[form]), form)
    assert rows.time.tolist() == time
    assert rows.values.tolist() == [[2.5, 7.0], [-1e-3, 8.0], [1.0, 9.0]]


STRANGE: dict[str, Callable[[bytes], bytes]] = {
    "mark of byte order": lambda text: b"\xef\xbb\xbf" + text,
    "DOS lines": lambda text: text.replace(b"\n", b"\r\n"),
    "blank last line": lambda text: text + b"\n",
    "blank last lines": lambda text: text + b"\r\n\r\n",
    "no last line end": lambda text: text.rstrip(),
}


@pytest.mark.parametrize("form", GOOD)
@pytest.mark.parametrize("strange", STRANGE)
def test_strangers_files(tmp_path: Path, form: FileFormat, strange: str) -> None:
    path = write(tmp_path, GOOD[form])
    expected = read(path, form)
    path.write_bytes(STRANGE[strange](GOOD[form].encode()))
    found = read(path, form)
    np.testing.assert_array_equal(found.time, expected.time)
    np.testing.assert_array_equal(found.values, expected.values)


@pytest.mark.parametrize(
    ("form", "old", "new"),
    [(SECONDS, "# t x n", "# 20 \xb0C"), (NAMED, "a, b", "20 \xb0C"), (MARKED, "a or b", "\xb0C")],
)
def test_a_latin_1_byte_where_nothing_is_read(
    tmp_path: Path, form: FileFormat, old: str, new: str
) -> None:
    path = tmp_path / "latin.txt"
    path.write_bytes(GOOD[form].replace(old, new).encode("latin-1"))
    assert read(path, form).values.tolist() == [[2.5, 7.0], [-1e-3, 8.0], [1.0, 9.0]]


@pytest.mark.parametrize(
    ("form", "stamp", "nanoseconds"),
    [
        (SECONDS, "1248444175.1031234567", 1248444175103123457),
        (SECONDS, "1248444175.10312345650000", 1248444175103123456),
        (SECONDS, "1.248444175103e+09", 1248444175103000000),
        (SECONDS, "1.25E9", 1250000000000000000),
        (SECONDS, "001248444175.1", 1248444175100000000),
        (NANOSECONDS, "1.248444175103E+18", 1248444175103000000),
        (NANOSECONDS, "1248444175103000000.000", 1248444175103000000),
    ],
)
def test_stamps_as_strangers_write_them(
    tmp_path: Path, form: FileFormat, stamp: str, nanoseconds: int
) -> None:
    sign = form.delimiter or " "
    assert read(write(tmp_path, sign.join((stamp, "1", "1"))), form).time.tolist() == [nanoseconds]


@pytest.mark.parametrize("value", ["1e308", "-2e9"])
def test_what_is_beyond_all_measure(tmp_path: Path, value: str) -> None:
    path = write(tmp_path, GOOD[SECONDS].replace("-1e-3", value))
    with pytest.raises(DataError, match=r"line 4: x is .*, beyond 1e\+09"):
        read(path, SECONDS)


def test_natural_order_without_hidden_files(tmp_path: Path) -> None:
    for name in ("r12.csv", "r2.csv", "r01.csv", ".DS_Store", "._r2.csv", "a10b2.csv", "a10b1.csv"):
        (tmp_path / name).touch()
    names = [path.name for path in folders.entries(tmp_path)]
    assert names == ["a10b1.csv", "a10b2.csv", "r01.csv", "r2.csv", "r12.csv"]


def test_no_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless(_: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", homeless)
    monkeypatch.delenv("COLOC_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert len(read(write(tmp_path, GOOD[SECONDS]), SECONDS).time) == 3
    monkeypatch.setenv("COLOC_DATA", "~/recordings")
    with pytest.raises(DataError, match="no home folder is known"):
        folders.data_root()


def test_windows_line_ends_and_no_last_one(tmp_path: Path) -> None:
    path = tmp_path / "dos.txt"
    path.write_bytes(GOOD[SECONDS].rstrip().replace("\n", "\r\n").encode())
    assert len(read(path, SECONDS).time) == 3


@given(stamps=st.lists(st.integers(0, 8_999_999_999_999_999_999), min_size=1))
def test_times_are_exact(tmp_path_factory: pytest.TempPathFactory, stamps: list[int]) -> None:
    folder = tmp_path_factory.mktemp("times")
    stamps.sort()
    seconds = [f"{t // 10**9}.{t % 10**9:09d} 1 1" for t in stamps]
    assert read(write(folder, "\n".join(seconds)), SECONDS).time.tolist() == stamps
    whole = [f"{t},1,1" for t in stamps]
    assert read(write(folder, "\n".join(whole)), NANOSECONDS).time.tolist() == stamps
    late = [t for t in stamps if t >= 10**18]
    powers = [f"{t // 10**18}.{t % 10**18:018d}e+18,1,1" for t in late]
    if powers:
        assert read(write(folder, "\n".join(powers)), NANOSECONDS).time.tolist() == late


@pytest.mark.parametrize(
    ("form", "old", "new", "reason"),
    [
        (SECONDS, "-1e-3  8", "-1e-3", "line 4: 2 columns, not 3"),
        (SECONDS, "-1e-3  8", "-1e-3 8 8", "line 4: 4 columns, not 3"),
        (SECONDS, "-1e-3", "1.2.3", "line 4: x is '1.2.3', not a number"),
        (SECONDS, "-1e-3", "nan", "line 4: x is not a finite number"),
        (SECONDS, "-1e-3", "1e999", "line 4: x is not a finite number"),
        (SECONDS, "8\n", "8.5\n", "line 4: n is 8.5, not a whole number"),
        (SECONDS, "175.115", "175.102", "line 4: the time is before that of the line above"),
        (SECONDS, "1248444175.115", "1.25e+12", "line 4: the time is 1.25e+12, not seconds"),
        (SECONDS, "1248444175.115", "nan", "line 4: the time is nan, not seconds since 1970"),
        (SECONDS, ".115", ".115" + 48 * "0", "line 4: the time is 1248444175.115000"),
        (SECONDS, "1248444175.115", "1e999999999", "line 4: the time is 1e999999999, not seconds"),
        (
            SECONDS,
            "1248444175.115",
            "1248444175.1e+0x",
            "line 4: the time is 1248444175.1e+0x, not",
        ),
        (SECONDS, "1248444175.115", "-1.5", "line 4: the time is -1.5, not seconds since 1970"),
        (SECONDS, "1248444175.115", "99999999999.5", "line 4: the time is 99999999999.5, not"),
        (NANOSECONDS, "977,-1", ".5,-1", "line 3: the time is 1403715273262142.5, not nanosec"),
        (NANOSECONDS, "-1e-3,8", "-1e-3", "line 3: 2 columns, not 3"),
        (NANOSECONDS, "-1e-3", "", "line 3: x is '', not a number"),
        (NAMED, "timestamp", "time", "line 1: the header does not name one column 'timestamp'"),
        (NAMED, "text", "x", "line 1: the header does not name one column 'x'"),
        (NAMED, ",c,", ",", "line 5: 3 columns, not 4"),
        (NAMED, ",c,", ",c,c,", "line 5: 5 columns, not 4"),
        (NAMED, "c,1.5", "c,nan", "line 5: the time is nan, not relative seconds"),
        (NAMED, "c,1.5", "c,1706818860.5", "line 5: the time is 1.70682e+09, not relative"),
        (NAMED, "c,1.5", "c,-1", "line 5: the time is before that of the line above"),
        (NAMED, "9,c", "nine,c", "line 5: n is 'nine', not a number"),
        (NAMED, "9,c", '9,"c', "line 5: 2 columns, not 4"),
        (STAMPED, "at,", "when,", "line 1: the header does not name one column 'at'"),
        (STAMPED, "426e+18", "426e+17", "line 3: the time is before that of the line above"),
        (STAMPED, "426e+18", "426e+185", "line 3: the time is 1.4037152732621426e+185, not"),
        (STAMPED, "1.4037", "14.037", "line 3: the time is 14.037152732621426e+18, not nanosec"),
        (STAMPED, "1.4037152732621426e", "1.4037152732621426123e", "line 3: the time is 1.403715"),
        (SECONDS, "1248444175.115", "1.248444175e+18", "line 4: the time is 1.248444175e+18, not"),
        (MARKED, "a 2 1", "c 2 1", "line 6: begins with 'c', not b or a"),
        (MARKED, "b 1 -1e-3 8", "b 1 -1e-3", "line 5: 3 columns, not 4"),
        (MARKED, "b 1.5 1 9", "b 1.5 one 9", "line 7: x is 'one', not a number"),
        (MARKED, "b 1.5 1 9", "b 1.5 1 9.5", "line 7: n is 9.5, not a whole number"),
    ],
)
def test_damage_is_located(
    tmp_path: Path, form: FileFormat, old: str, new: str, reason: str
) -> None:
    assert GOOD[form].count(old) == 1
    path = write(tmp_path, GOOD[form].replace(old, new))
    with pytest.raises(DataError) as caught:
        read(path, form)
    assert str(caught.value).startswith(f"{path}, {reason}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", GOOD)
@pytest.mark.parametrize("content", [b"", b"\n\n", b"# only a comment\n", b"x,n,timestamp\n"])
def test_nothing_in_it(tmp_path: Path, form: FileFormat, content: bytes) -> None:
    path = tmp_path / "empty"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"no data|line 1"):
        read(path, form)


@pytest.mark.parametrize("form", GOOD)
def test_foreign_files(tmp_path: Path, form: FileFormat) -> None:
    path = tmp_path / "foreign"
    for content in [b"\x80\x81\xff\x00PNG\r\n", *(GOOD[f].encode() for f in GOOD if f != form)]:
        path.write_bytes(content)
        with pytest.raises(DataError, match=str(path)):
            read(path, form)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"away\.txt: no such file"):
        read(tmp_path / "away.txt", SECONDS)


def test_fail_counts_data_rows(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD[SECONDS])
    with pytest.raises(DataError, match="line 5: because"):
        fail(path, SECONDS, np.array([False, False, True]), "because")


def test_distinct_keeps_the_first(tmp_path: Path) -> None:
    rows = distinct(read(write(tmp_path, GOOD[NANOSECONDS]), NANOSECONDS))
    assert rows.values[:, 1].tolist() == [7.0, 8.0]


def test_cache_is_used_and_renewed(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path, GOOD[SECONDS])
    first = read(path, SECONDS)
    with monkeypatch.context() as patched:
        patched.setattr(files, "_parse", lambda *_: pytest.fail("parsed again"))
        again = read(path, SECONDS)
    np.testing.assert_array_equal(first.time, again.time)
    np.testing.assert_array_equal(first.values, again.values)
    path.write_text(GOOD[SECONDS].replace("2.5", "3.5"), encoding="utf-8")
    os.utime(path, ns=(0, 0))
    assert read(path, SECONDS).values[0, 0] == 3.5
    assert len(list(cache.iterdir())) == 1


@pytest.mark.parametrize("damage", ["empty", "cut", "garbage", "other", "bit"])
def test_damaged_cache_is_rebuilt(tmp_path: Path, cache: Path, damage: str) -> None:
    path = write(tmp_path, GOOD[SECONDS])
    first = read(path, SECONDS)
    (entry,) = cache.iterdir()
    content = bytearray(entry.read_bytes())
    if damage == "bit":
        content[content.index(np.float64(2.5).tobytes())] ^= 1
    if damage == "other":
        with entry.open("wb") as file:
            np.savez(file, version=np.zeros(3))
    else:
        kinds = {
            "empty": bytearray(),
            "cut": content[:300],
            "garbage": bytearray(99),
            "bit": content,
        }
        entry.write_bytes(kinds[damage])
    np.testing.assert_array_equal(read(path, SECONDS).values, first.values)
    with np.load(entry) as saved:
        np.testing.assert_array_equal(saved["values"], first.values)


def test_cache_that_cannot_be_written_is_no_error(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.write_text("a file where the folder should be", encoding="utf-8")
    assert len(read(write(tmp_path, GOOD[SECONDS]), SECONDS).time) == 3


def test_data_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLOC_DATA", str(tmp_path))
    assert folders.data_root() == tmp_path
    assert folders.data_root(tmp_path.parent) == tmp_path.parent
    for call in (
        lambda: folders.data_root(tmp_path / "away"),
        lambda: folders.dataset_folder("euroc"),
    ):
        with pytest.raises(DataError, match=r"COLOC_DATA or --data.* \(from http") as caught:
            call()
        assert str(tmp_path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_data_root_without_setting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLOC_DATA", raising=False)
    module = tmp_path / "checkout" / "coloc_env" / "datasets" / "files.py"
    monkeypatch.setattr(folders, "__file__", str(module))
    with pytest.raises(DataError, match="no folder of recordings is known"):
        folders.data_root()
    module.parent.mkdir(parents=True)
    (tmp_path / "checkout" / "pyproject.toml").touch()
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert folders.data_root() == tmp_path / "shared" / "data"
