"""Plan files: what is written is read, and whatever is wrong is told by its field."""

import copy
import json
import re
from pathlib import Path

import pytest

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.plan import find_plan, read_plan, write_plan
from adis_gonio.record.plans import PLAN_NAMES, Plan, Position, document_of, plan, plan_from

DOCS = Path(__file__).parents[2] / "docs"

MADE = Plan(
    "angle-4",
    (Position(0.0), Position(187.5, -1), Position(90.0, wait_s=30.0), Position(270.0, use="check")),
)


def test_a_plan_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "best.json"
    write_plan(path, MADE, {"best": "angle", "figure": float("nan")})
    assert read_plan(path) == MADE
    assert find_plan(str(path)) == MADE
    assert json.loads(path.read_text("utf-8"))["made_for"] == {"best": "angle", "figure": None}


def test_a_position_needs_no_more_than_its_angle():
    document = document_of(MADE)
    document["positions"] = [{"angle_deg": 0}, {"angle_deg": 90}]
    assert plan_from(document).positions == (Position(0.0), Position(90.0))


@pytest.mark.parametrize("name", PLAN_NAMES)
def test_a_name_is_the_plan_of_that_name(name):
    assert find_plan(name) == plan(name)


def test_check_positions_are_added_and_a_number_of_positions_is_refused(tmp_path):
    path = tmp_path / "best.json"
    write_plan(path, MADE)
    assert sum(p.use == "check" for p in find_plan(str(path), check=2).positions) == 3
    with pytest.raises(UsageError, match="leave --positions out"):
        find_plan(str(path), 5)
    with pytest.raises(UsageError, match="did you mean 'tumble'"):
        find_plan("tumbel")
    with pytest.raises(DataError, match="cannot be read"):
        find_plan(str(tmp_path / "none.json"))


def changed(*keys, to):
    document = copy.deepcopy(document_of(MADE))
    place = document
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = to
    return document


@pytest.mark.parametrize(
    ("document", "told"),
    [
        ([], "schema is not"),
        (changed("schema", to="x"), "schema is not"),
        (changed("version", to=2), "version is 2, .*: update adis-gonio"),
        (changed("version", to=0), "version is 0, .*: take 1"),
        (changed("version", to=True), "version is True"),
        (changed("version", to=None), "version is None"),
        (changed("name", to="tumble"), "name is 'tumble'"),
        (changed("name", to="two words"), "name is 'two words'"),
        (changed("name", to=7), "name is 7"),
        (changed("plane", to="none"), "plane is 'none'"),
        (changed("positions", to=[]), "positions is .*: expected a list of 2 to"),
        (changed("positions", to={"a": 1}), "positions is .*: expected a list of 2 to"),
        (changed("positions", 1, to=3), r"positions\[1\] is 3"),
        (changed("positions", 1, "angle_deg", to="ninety"), r"positions\[1\].angle_deg is 'ninety'"),
        (changed("positions", 1, "angle_deg", to=None), r"positions\[1\].angle_deg is None"),
        (changed("positions", 1, "angle_deg", to=True), r"positions\[1\].angle_deg is True"),
        (changed("positions", 1, "angle_deg", to=float("nan")), r"positions\[1\].angle_deg is nan"),
        (changed("positions", 0, "angle_deg", to=4000), r"positions\[0\].angle_deg is 4000"),
        (changed("positions", 2, "approach", to=0), r"positions\[2\].approach is 0"),
        (changed("positions", 2, "approach", to=[1]), r"positions\[2\].approach is \[1\]"),
        (changed("positions", 3, "use", to="both"), r"positions\[3\].use is 'both'"),
        (changed("positions", 3, "use", to={}), r"positions\[3\].use is {}"),
        (changed("positions", 3, "wait_s", to=-1), r"positions\[3\].wait_s is -1"),
        (changed("positions", 3, "angel", to=1), r"positions\[3\] contains 'angel', which is not known"),
        (changed("position", to=[]), "contains 'position', which is not known"),
        (changed("", to=1), "contains '', which is not known"),
    ],
)
def test_what_is_wrong_is_told_in_one_line_by_its_field(document, told, tmp_path):
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(DataError, match=told) as caught:
        read_plan(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ('"plane": "xy"', '"plane": "xy", "name": "other"', "'name' is given twice"),
        ('"angle_deg": 90.0', '"angle_deg": 90.0, "angle_deg": 91.0', "'angle_deg' is given twice"),
        ('"plane": "xy"', '"plane": "xy", "made_for": {"a": 1, "a": 2}', "'a' is given twice"),
    ],
)
def test_a_field_that_stands_twice_is_told_and_none_of_both_taken(before, after, told, tmp_path):
    path = tmp_path / "twice.json"
    text = json.dumps(document_of(MADE))
    assert before in text
    path.write_text(text.replace(before, after), encoding="utf-8")
    with pytest.raises(DataError, match=told) as caught:
        read_plan(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_byte_order_mark_is_no_reason_to_refuse_a_plan(tmp_path):
    path = tmp_path / "notepad.json"
    path.write_text(json.dumps(document_of(plan("tumble")) | {"name": "mine"}), encoding="utf-8-sig")
    assert len(read_plan(path)) == len(plan("tumble"))


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000])
def test_what_is_no_json_is_no_plan(content, tmp_path):
    path = tmp_path / "wrong.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match="is no plan"):
        read_plan(path)


def test_a_plan_of_nothing_but_checks_is_refused():
    document = document_of(MADE)
    for entry in document["positions"]:
        entry["use"] = "check"
    with pytest.raises(DataError, match="all for checking"):
        plan_from(document)


def test_the_pages_show_a_plan_that_is_read_and_code_that_runs(capsys):
    (shown,) = re.findall(r"```json\n(.*?)```", (DOCS / "files.md").read_text("utf-8"), re.S)
    assert len(plan_from(json.loads(shown))) == 4
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "plans.md").read_text("utf-8"), re.S)
    exec(compile(code, "docs/plans.md", "exec"), {})
    told = capsys.readouterr().out.splitlines()
    assert "bias_drift.drift_x" in told[0]
    assert 0.005 < float(told[1]) < 0.05
