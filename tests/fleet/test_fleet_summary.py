"""What a fleet says, against independent libraries and against truth that was put in."""

from __future__ import annotations

import json
import math
import zlib

import numpy as np
import pytest
from scipy.stats import binom, fisher_exact

from adis_gonio.base.uncertainty import OUTLYING
from adis_gonio.fleet.fleet_pages import build_page, fleet_sections
from adis_gonio.fleet.fleet_summary import by_rank, by_share, by_unit, robust_z, summarise
from adis_gonio.fleet.session_record import COLUMNS, SessionRecord, write_parquet
from fleet.sessions import quiet_rows, row


@pytest.fixture
def rng(request):
    """One for each test, always the same."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


def found(summary):
    return {(one.kind, one.name, one.quantity) for one in summary.outlying}


def on_stages(rng, units, stages):
    """Sensors with a u of 0.05° by the stage's certificate and 0.01° of their own; one is off by 0.1°."""
    error = dict.fromkeys(stages, 0.05 * rng.normal())
    facts = {"delta_phi_u": math.hypot(0.05, 0.01), "delta_phi_stage": [0.05]}
    rows = [
        row(k, serial=f"SN{k}", stage_curve=one, delta_phi=error[one] + 0.01 * rng.normal(), **facts)
        for k, one in enumerate(stages[k % len(stages)] for k in range(units))
    ]
    rows[7]["delta_phi"] += 0.1
    return rows


def test_sessions_on_one_stage_share_the_error_that_its_certificate_leaves(rng):
    """Only their own u counts in a comparison; on two stages the whole u does."""
    assert found(summarise(on_stages(rng, 40, "a"))) == {("unit", "SN7", "delta_phi")}
    assert not found(summarise(on_stages(rng, 40, "ab")))


def test_in_fleets_without_any_odd_one_hardly_ever_anyone_is_named(rng):
    named = sum(bool(summarise(quiet_rows(rng, 60)).outlying) for _ in range(100))
    assert named <= binom.ppf(0.999, 100, OUTLYING)


def test_a_good_unit_of_a_small_fleet_is_as_improbable_as_its_p_value_says(rng):
    units, level, fleets = 9, 3e-3, 6000
    named = 0
    for values in rng.normal(size=(fleets, units)):
        named += len(by_unit("bias_x", values, np.zeros(units), np.arange(units)).find(level))
    assert 0.6 < named / (fleets * units * level) < 1.2


def test_a_stage_an_operator_and_a_unit_that_are_odd_are_named_and_nobody_else(
    rng,
):
    rows = quiet_rows(rng, 240)
    for one in rows:
        if one["stage"] == "stage 2":
            one["effects"] = sorted({*one["effects"], "eccentricity"})
        if one["operator"] == "op 1":
            one["bias_x"] += 3
    rows[17]["delta_k"] += 12
    summary = summarise(rows)
    assert found(summary) == {
        ("stage", "stage 2", "effect eccentricity"),
        ("operator", "op 1", "bias_x"),
        ("unit", "SN17", "delta_k"),
    }
    stage = next(one for one in summary.outlying if one.kind == "stage")
    assert stage.value == 1.0
    assert stage.others == pytest.approx(0.2, abs=0.1)
    for one in summary.outlying:
        assert one.adjusted_p == pytest.approx(one.p_value * summary.tests)
        assert one.adjusted_p < OUTLYING


def test_the_table_of_outlying_groups_has_shares_in_percent_and_angles_in_degrees(rng):
    rows = quiet_rows(rng, 60)
    for one in rows:
        if one["stage"] == "stage 2":
            one["effects"] = sorted({*one["effects"], "eccentricity"})
    rows[17]["angle"] = 7.5
    median = np.median([one["angle"] for one in rows])
    sections = {section.title: section for section in fleet_sections(summarise(rows), figures=False)}
    shown = {tuple(texts[:2]): texts[2:4] for texts in sections["Outlying groups"].tables[0].rows}
    assert shown["unit SN17", "angle error, rms"] == ["7.50°", f"{median:.4f}°"]
    here, others = shown["stage stage 2", "effect eccentricity"]
    assert here == ">\N{NO-BREAK SPACE}99.9\N{NO-BREAK SPACE}%"
    assert others.endswith("%")


@pytest.mark.parametrize(
    ("stages", "tests"),
    [("aabb", 0), ("abcde", 5), ("aabbbb", 6), ("aaabbb", 6 + 2), ("aaabb", 5)],
)
def test_five_sensors_or_three_on_a_stage_and_three_elsewhere_can_be_compared(stages, tests):
    rows = [row(k, serial=f"SN{k}", stage=stage, bias_x=float(k)) for k, stage in enumerate(stages)]
    assert summarise(rows).tests == tests


def test_of_two_groups_the_smaller_is_the_odd_one_and_others_are_compared_without_it():
    values, unit = np.arange(60.0), np.arange(60)
    two = by_rank("stage", "bias_x", values, (unit >= 40).astype(int), unit).find(0.01)
    assert [(one.code, one.n, one.value, one.others) for one in two] == [(1, 20, 49.5, 19.5)]
    two = by_rank("stage", "bias_x", values, (unit < 40).astype(int), unit).find(0.01)
    assert [one.code for one in two] == [0]
    # One stage has the largest values, one the smallest, four have the rest.
    stage = np.r_[np.full(8, 5), np.arange(60) % 4, np.full(12, 4)]
    both = by_rank("stage", "bias_x", np.arange(80.0), stage, np.arange(80)).find(0.001)
    assert [(one.code, one.value, one.others) for one in both] == [(4, 73.5, 33.5), (5, 3.5, 37.5)]


def test_equal_sensors_without_u_do_not_differ():
    z, middle = robust_z(np.full(6, 2.0), np.zeros(6))
    assert (z.tolist(), middle) == ([0.0] * 6, 2.0)


def test_many_sessions_of_one_unit_are_no_many_witnesses_against_a_stage(rng):
    rows = quiet_rows(rng, 60)
    for k in range(30):
        rows.append(row(100 + k, **{**rows[0], "path": f"x{k}", "stage": "new stage", "bias_x": 9.0}))
    assert not {one for one in found(summarise(rows)) if one[0] == "stage"}


def test_a_share_is_judged_as_by_fishers_exact_test():
    shown = np.r_[np.ones(5), np.zeros(3), np.ones(4), np.zeros(40)].astype(bool)
    group = np.r_[np.zeros(8), np.ones(44)].astype(int)
    test = by_share("stage", "x", shown, group, np.arange(52)).find(1.0)[0]
    assert test.p_value == pytest.approx(fisher_exact([[5, 3], [4, 40]], "greater").pvalue)


def test_a_sensor_has_an_effect_if_half_of_its_sessions_show_it():
    shown, unit = np.tile([True, False], 10), np.repeat(np.arange(10), 2)
    stage = (unit >= 5).astype(int)
    shown[stage == 1] = False
    (test,) = by_share("stage", "x", shown, stage, unit).find(0.01)
    assert (test.code, test.value, test.others, test.n) == (0, 1.0, 0.0, 5)


def test_the_order_of_rows_changes_nothing(rng):
    rows = quiet_rows(rng, 50)
    first = json.dumps(summarise(rows).as_dict())
    assert json.dumps(summarise([rows[k] for k in rng.permutation(50)]).as_dict()) == first


def test_failed_rows_are_counted_and_take_no_part(rng):
    rows = quiet_rows(rng, 20)
    failed = SessionRecord("broken.csv", status="failed", reason="broken.csv, row 3: no number").row()
    document = summarise([*rows, failed]).as_dict()
    assert document["sessions"]["failed"] == 1
    assert document["failures"] == [{"path": "broken.csv", "reason": "broken.csv, row 3: no number"}]
    assert document["parameters"] == summarise(rows).as_dict()["parameters"]
    assert summarise([failed]).as_dict()["parameters"] == {}


def test_duckdb_can_ask_the_table_and_every_column_is_described(tmp_path, rng):
    duckdb = pytest.importorskip("duckdb")
    rows, path = quiet_rows(rng, 90), tmp_path / "fleet.parquet"
    write_parquet(rows, path, {"software": "test"})
    asked = duckdb.sql(
        "select stage, count(*), avg(delta_k), count(*) filter (list_contains(effects, 'backlash'))"
        f" from '{path}' where status = 'ok' group by stage order by stage"
    ).fetchall()
    for stage, count, mean, backlash in asked:
        own = [one for one in rows if one["stage"] == stage]
        assert (count, backlash) == (len(own), sum("backlash" in one["effects"] for one in own))
        assert mean == pytest.approx(np.mean([one["delta_k"] for one in own]))
    assert len(asked) == 4
    table = pytest.importorskip("pyarrow.parquet").read_table(path)
    assert table.column_names == list(COLUMNS)
    for field in table.schema:
        assert field.metadata[b"meaning"]
        assert field.metadata[b"unit"] == COLUMNS[field.name][1].encode()
    assert summarise(table.to_pylist()).as_dict() == summarise(rows).as_dict()


def test_the_page_says_what_the_summary_says_and_escapes_what_files_say(rng):
    rows = quiet_rows(rng, 120)
    for one in rows:
        if one["stage"] == "stage 3":
            one |= {"stage": "<script>x</script>", "bias_x": one["bias_x"] + 5}
    rows.append(SessionRecord("<b>.csv", status="failed", reason="<i>").row())
    page = build_page(summarise(rows), population=["One effect is common to all."])
    assert page == build_page(summarise(list(reversed(rows))), population=["One effect is common to all."])
    assert "120 of 121" in page
    assert "robust sd" in page, "the parameters have a table"
    assert "One effect is common to all." in page
    assert "stage &lt;script&gt;x&lt;/script&gt;" in page
    assert "<script>" not in page
    assert "<i>" not in page
    assert "&lt;b&gt;.csv" in page
