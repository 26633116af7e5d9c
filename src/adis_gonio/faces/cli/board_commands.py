"""The commands `bringup` and `write`, which check a board and write its registers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import json_text
from adis_gonio.base.numbers import format_number, signed, use_minus
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import console, opened, print_json, print_table, report_written, say
from adis_gonio.faces.cli.terminal import on_terminal

if TYPE_CHECKING:
    from adis_gonio.bench.bringup import StepResult
    from adis_gonio.bench.writeback import OffsetWriter, WritePlan


def _report_files(output: Path) -> tuple[Path, Path]:
    """Return the paths of the HTML page and the JSON document, which differ only in their ending."""
    if output.suffix.lower() not in ("", ".html", ".json"):
        raise UsageError(f"{output}: bringup writes a page and a JSON: name it {output.stem}.html")
    return output.with_suffix(".html"), output.with_suffix(".json")


@option.command("bringup", "--output --allow-writes --yes --from")
@click.argument("url", required=False)
@click.option(
    "--from", "recordings", type=option.FILE, multiple=True, metavar="FILE",
    help="Compare the register table with this recording or capture; may be given several times.",
)  # fmt: skip
@option.output("Write FILE.html and FILE.json.", paths=_report_files)
@option.flag("--allow-writes", "--writes", help="Also run the steps that write registers.")
@option.flag("--flash", help="With --allow-writes: also write the flash once.")
@option.flag("--yes", help="Answer yes to the question of each step that writes.")
@option.variant
@option.json
def bringup_command(
    *,
    url: str | None,
    recordings: tuple[Path, ...],
    output: Path | None,
    allow_writes: bool,
    flash: bool,
    yes: bool,
    variant: str,
    as_json: bool,
) -> int:
    """Check a new board step by step, harmless steps first, and report the properties of its part.

    Lay the part still, best with one axis along gravity. The first steps only read: link, bit errors,
    supply, variant, sample rate, data-ready and noise (data-ready is enabled during these steps, as in a
    stream). With --allow-writes, further steps settle open questions of the register table. Each asks
    first, and everything written is undone and read back, also after Ctrl-C. The exit status is 1 if a step
    found a fault.

    With --from, and without a URL, files of record: or VCD captures are compared with the rows of the
    register table instead: bringup --from run.rec --from capture.vcd. All files must be of one part.
    """
    if recordings and not (url or output or allow_writes or flash or yes):
        return _judge(recordings, variant, as_json=as_json)
    if recordings or url is None:
        raise UsageError("give the URL of a board, or --from FILE with at most --sensor and --json")
    option.refuse(() if allow_writes else ("flash", "yes"), "goes with --allow-writes")
    _require_terminal(allow_writes and not yes, "--allow-writes asks before each step")
    files = () if output is None else _report_files(output)
    from adis_gonio.bench.bringup import Permission, bring_up
    from adis_gonio.device.bus import open_bus
    from adis_gonio.device.sensor.registers import variant as find_variant

    def ask(question: str) -> bool:
        try:
            return yes or click.confirm(question, default=False, err=True)
        except click.Abort:
            raise KeyboardInterrupt from None

    def tell(row: StepResult) -> None:
        say(f"{row.verdict:13} {row.name:15} {row.text}", err=as_json, hang=30)

    part = find_variant(variant)
    permission = Permission(allow_writes, flash, ask)
    with open_bus(url) as bus:
        found = bring_up(bus, variant=part, permission=permission, tell=tell)
    if files:
        from adis_gonio.base.output import write_text
        from adis_gonio.bench.bringup.bringup_run import build_page

        page, document = files
        for path, text in ((document, json_text(found.as_dict())), (page, build_page(found))):
            write_text(path, text)
            report_written(path)
    if as_json:
        print_json(found.as_dict())
    else:
        click.echo()
        say(f"{found.headline} Writes: {found.undone}.", err=False)
    if found.stopped:
        raise KeyboardInterrupt
    return 0 if found.sound else 1


def _require_terminal(asks: bool, question: str) -> None:
    """Raise `UsageError` if a command asks the operator and standard input is no terminal."""
    if asks and not on_terminal():
        raise UsageError(f"{question}, and standard input is no terminal: add --yes")


def _judge(recordings: tuple[Path, ...], variant: str, *, as_json: bool) -> int:
    from adis_gonio.bench.bringup.chip_rows import findings_text, judge_recordings
    from adis_gonio.device.sensor.registers import variant as find_variant

    findings = judge_recordings(recordings, find_variant(variant))
    if as_json:
        files = [str(path) for path in recordings]
        print_json({"files": files, "rows": [finding.as_dict() for finding in findings]})
    else:
        click.echo(findings_text(findings))
    return 0


@option.command("write", "--dry-run --save --undo")
@option.session
@option.url
@option.flag("--save", help="Save to flash after verification (ENDURANCE goes up by one).")
@option.flag("--undo", help="Restore the offsets from before the write.")
@option.flag("--status", help="Only report whether the sensor holds the old or the new offsets.")
@option.flag("--dry-run", help="Measure, check and show the plan; write nothing.")
@option.flag("--yes", help="Write without asking.")
@click.option(
    "--at", "angle_deg", type=float, metavar="DEGREES",
    help="Current angle of the stage, as in the session (default: compare only the length of gravity).",
)  # fmt: skip
@option.dwell(5.0)
@click.option("--method", help="Method as in `fit` (default: the recommended one).")
@option.flag(
    "--gyros", help="Write the zero rates of the gyros (XGYRO_OFF …) instead of accelerometer biases."
)
@option.flag(
    "--autonull", help="With --gyros: let the chip null its gyros (30 s) and save that to flash; keep the"
    " result if it agrees with the session."
)  # fmt: skip
@option.flag("--even-if-inadequate", help="Write even if the fit is inadequate.")
@option.no_check
@option.json
def write_command(
    *,
    session: Path,
    url: str,
    undo: bool,
    status: bool,
    dry_run: bool,
    yes: bool,
    as_json: bool,
    no_check: bool,
    **options: Any,
) -> int:
    """Write a session's biases into the sensor's offset registers, so that the sensor corrects them itself.

    Keep the part still, mounted as in the session. The command first shows the plan: the present and the
    new register values, and their effect in mg. Then y writes, and Enter changes nothing. The written
    values are read back and verified by a dwell; if the dwell contradicts the plan, the old offsets are
    restored. A power cut loses the new offsets unless --save puts them into flash.

    Accelerometers and gyros are written separately: --gyros writes the zero rates, without the part due to
    gravity, if the session calibrates them; --gyros --undo restores only those.

    The session file keeps the old offsets for --undo. After a power cut, a Ctrl-C or an error run the
    command again: it reports whether the old or the new offsets are in place, and finishes; --status only
    reports.
    """
    if sum((undo, status, dry_run)) > 1:
        raise UsageError("--undo, --status and --dry-run exclude each other")
    null = options["autonull"]
    if null and (not options["gyros"] or undo or status or options["save"]):
        raise UsageError("--autonull goes with --gyros, and without --undo, --status and --save (it saves)")
    _require_terminal(not (yes or status or dry_run), "write asks before it writes")
    from adis_gonio.bench.writeback import OffsetWriter, WriteSettings
    from adis_gonio.bench.writeback.offset_writer import load
    from adis_gonio.device.sensor import open_sensor
    from adis_gonio.faces.free_hands import free_hands
    from adis_gonio.record.source import refuse_chip_options

    refuse_chip_options(url, {"write SESSION": True})
    settings = WriteSettings(
        **{name: options[name] for name in ("save", "angle_deg", "dwell_s", "method", "gyros")},
        doubtful=options["even_if_inadequate"],
    )
    chip = {"variant": load(session).sensor, "check": not no_check}
    with free_hands(url) as (port, _), opened(open_sensor, port, **chip) as sensor:
        writer = OffsetWriter(sensor, session, settings, tell=say)
        state = writer.standing()
        if status:
            document: dict[str, Any] = {"state": state.as_dict(), "plan": None, "done": False}
        else:
            if state.registers != "untouched":
                say(state.text)
            document = (
                _undo(writer, yes=yes)
                if undo
                else _write(writer, yes=yes, dry_run=dry_run, quiet=as_json, null=null)
            )
    known = document["state"]["registers"] in ("untouched", "old", "new")
    if as_json:
        print_json(document)
    if not (as_json and known):
        say(document["state"]["text"], err=as_json)
    return 0 if known else 1


def _write(writer: OffsetWriter, *, yes: bool, dry_run: bool, quiet: bool, null: bool) -> dict[str, Any]:
    plan = writer.plan()
    if not quiet:
        _print_plan(plan)
    document = {"plan": plan.as_dict(), "state": writer.standing().as_dict(), "done": False}
    if dry_run:
        return document
    if null:
        say(
            "the chip takes the outputs of this pose for zero rates, including the part due to gravity; it"
            " saves them to flash, with all other registers that have a copy there (ENDURANCE goes up by"
            " one, or by two if the null has to be undone)"
        )
        answer = "null" if yes or _confirm("Let the chip null its gyros?") else "leave"
    else:
        answer = "write" if yes else _ask_to_write(writer, plan)
    if answer == "leave":
        say("nothing was changed")
        return document
    act = {"null": writer.autonull, "back": writer.undo}.get(answer, writer.write)
    return document | {"done": True} | act().as_dict()


def _undo(writer: OffsetWriter, *, yes: bool) -> dict[str, Any]:
    if not (yes or _confirm("Set the old offsets back?")):
        say("nothing was changed")
        return {"plan": None, "state": writer.standing().as_dict(), "done": False}
    return {"plan": None, "done": True} | writer.undo().as_dict()


def _ask_to_write(writer: OffsetWriter, plan: WritePlan) -> str:
    """Ask the operator if the plan is to be carried out, and return the decision.

    It is `write` (carry out the plan), `back` (restore the old offsets after an unfinished write) or
    `leave` (change nothing). A plan without changes gives `write` without a question.
    """
    if writer.standing().registers == "half":
        question = "An earlier write was not finished: finish it (f), set it back (b), or leave it (Enter)"
        return {"f": "write", "b": "back"}.get(_prompt(question)[:1], "leave")
    if not plan.changes and not writer.settings.save:
        return "write"
    flash = " and save to flash" if writer.settings.save else ""
    return "write" if _confirm(f"Write{flash}?") else "leave"


def _confirm(question: str) -> bool:
    return _prompt(f"{question} [y, Enter changes nothing]") in ("y", "yes")


def _prompt(question: str) -> str:
    return str(click.prompt(question, default="", show_default=False, err=True)).strip().lower()


def _print_plan(plan: WritePlan) -> None:
    """Show a plan for offset registers as a table with one row for each axis, and its doubts."""
    from adis_gonio.bench.writeback.offset_plan import UNITS

    head = ("register", "now", "new", "moves the output", "bias now", "u", "bias after")
    rows = []
    for axis in plan.axes:
        unit, places = UNITS[axis.unit], 2 if axis.unit == "mg" else 3
        moved, bias, after = (
            f"{signed(value, places)} {unit}" for value in (axis.effect, axis.bias_now, axis.bias_after)
        )
        u = f"{format_number(axis.u, 2)} {unit}"
        rows.append(
            (axis.register, use_minus(str(axis.now)), use_minus(str(axis.new)), moved, bias, u, after)
        )
    print_table(console(), head, rows)
    for axis in plan.axes:
        if axis.clipped:
            say(f"{axis.register} is at its limit: {signed(axis.bias_after, 1)} mg of the bias remain")
        if axis.now != axis.recorded:
            say(f"{axis.register} was {axis.recorded} when the session was recorded")
    for doubt in plan.doubts:
        say(f"doubtful: {doubt}")
