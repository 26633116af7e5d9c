"""`adis-gonio write`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import console, print_json, table_of

if TYPE_CHECKING:
    from adis_gonio.bench.writeback import OffsetWriter, WritePlan


@click.command("write")
@option.session
@option.url
@click.option("--save", is_flag=True, help="Save to flash when it is verified (ENDURANCE goes up by one).")
@click.option("--undo", is_flag=True, help="Set the offsets back to what they were before the write.")
@click.option("--status", is_flag=True, help="Only say what the sensor holds of what was written.")
@click.option("--dry-run", is_flag=True, help="Measure, check and show the plan; write nothing.")
@click.option("--yes", is_flag=True, help="Write without asking.")
@click.option(
    "--at", "angle_deg", type=float, metavar="DEGREES",
    help="Angle at which the stage stands, as in the session; without it gravity's length is compared.",
)  # fmt: skip
@option.dwell(5.0)
@click.option("--method", help="As fit's; without it the best that the session supports.")
@click.option(
    "--gyros", is_flag=True,
    help="Write the zero rates of the gyros (XGYRO_OFF …) in place of the accelerometers' biases.",
)  # fmt: skip
@click.option(
    "--autonull", type=click.Choice(["quick", "precise"]),
    help="With --gyros: let the chip null its gyros, and keep that only where the session agrees; "
    "precise takes 30 s. It saves to flash by itself.",
)  # fmt: skip
@click.option("--even-if-inadequate", is_flag=True, help="Write although the fit is no sound base.")
@option.no_check
@option.json
def command(
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

    Keep the part still, mounted as in the session. The plan comes first: what is in the registers, what is
    to be, and what that does in mg; then Enter changes nothing and y writes. What was written is read back
    and verified by a dwell; where that does not show what was planned the old offsets are set back. The new
    ones are lost with the power unless --save puts them into flash.

    Accelerometers and gyros are written apart: --gyros takes the zero rates, without what gravity adds to
    them, where the session calibrates them; --gyros --undo sets those back alone.

    What was there before is kept in the session file, for --undo. After a power cut, a Ctrl-C or an error
    run write again: it says whether the old or the new offsets stand, and finishes; --status only says it.
    """
    if sum((undo, status, dry_run)) > 1:
        raise UsageError("--undo, --status and --dry-run exclude each other")
    null = options["autonull"]
    if null and (not options["gyros"] or undo or status or options["save"]):
        raise UsageError("--autonull goes with --gyros, and without --undo, --status and --save (it saves)")
    if not (yes or status or dry_run or at_a_terminal()):
        raise UsageError(
            "write asks before it writes, and nobody is there to answer: add --yes or --dry-run"
        )
    from adis_gonio.bench.writeback import OffsetWriter, WriteSettings
    from adis_gonio.bench.writeback.offset_writer import load
    from adis_gonio.device.sensor import open_sensor
    from adis_gonio.record.source import refuse_chip_options

    refuse_chip_options(url, {"write SESSION": True})
    settings = WriteSettings(
        save=options["save"],
        angle_deg=options["angle_deg"],
        dwell_s=options["dwell_s"],
        method=options["method"],
        doubtful=options["even_if_inadequate"],
        gyros=options["gyros"],
    )
    variant = load(session).sensor
    with open_sensor(url, variant=variant, check=not no_check) as sensor:
        writer = OffsetWriter(sensor, session, settings, tell=_tell)
        standing = writer.standing()
        if status:
            document: dict[str, Any] = {"state": standing.as_dict(), "plan": None, "done": False}
        elif undo:
            _tell(standing.text)
            document = _undo(writer, yes=yes)
        else:
            _tell(standing.text)
            document = _write(writer, yes=yes, dry_run=dry_run, quiet=as_json, null=null)
    if as_json:
        print_json(document)
    else:
        click.echo(document["state"]["text"])
    return 0 if document["state"]["registers"] in ("untouched", "old", "new") else 1


def _write(
    writer: OffsetWriter, *, yes: bool, dry_run: bool, quiet: bool, null: str | None
) -> dict[str, Any]:
    plan = writer.plan()
    if not quiet:
        print_plan(plan)
    document = {"plan": plan.as_dict(), "state": writer.standing().as_dict(), "done": False}
    if dry_run:
        return document
    if null:
        return _autonull(writer, document, null, yes=yes)
    answer = "write" if yes else _asked(writer, plan)
    if answer == "back":
        return document | {"done": True} | writer.undo().as_dict()
    if answer == "leave":
        _tell("nothing was changed")
        return document
    return document | {"done": True} | writer.write().as_dict()


def _autonull(writer: OffsetWriter, document: dict[str, Any], null: str, *, yes: bool) -> dict[str, Any]:
    _tell(
        "the chip's null takes the outputs of this pose for zero rates, what force adds here too; the part "
        "saves it to flash by itself, with all registers that have a copy there (ENDURANCE goes up by one, "
        "by two where it has to be set back)"
    )
    if not (yes or _confirm("Let the chip null its gyros?")):
        _tell("nothing was changed")
        return document
    return document | {"done": True} | writer.autonull(precise=null == "precise").as_dict()


def _undo(writer: OffsetWriter, *, yes: bool) -> dict[str, Any]:
    if not (yes or _confirm("Set the old offsets back?")):
        _tell("nothing was changed")
        return {"plan": None, "state": writer.standing().as_dict(), "done": False}
    return {"plan": None, "done": True} | writer.undo().as_dict()


def _asked(writer: OffsetWriter, plan: WritePlan) -> str:
    if writer.standing().registers == "half":
        asked = "An earlier write was not finished: finish it (f), set it back (b), or leave it (Enter)"
        answer = _prompt(asked).strip().lower()[:1]
        return {"f": "write", "b": "back"}.get(answer, "leave")
    flash = " and save to flash" if writer.settings.save else ""
    if not plan.changes and not writer.settings.save:
        return "write"
    return "write" if _confirm(f"Write{flash}?") else "leave"


def at_a_terminal() -> bool:
    """True where somebody can answer a question."""
    return sys.stdin.isatty()


def _confirm(question: str) -> bool:
    return _prompt(f"{question} [y, Enter changes nothing]").strip().lower() in ("y", "yes")


def _prompt(question: str) -> str:
    try:
        return str(click.prompt(question, default="", show_default=False, err=True))
    except click.Abort:
        raise KeyboardInterrupt from None


def print_plan(plan: WritePlan) -> None:
    """Show a plan: a row an axis."""
    from adis_gonio.bench.writeback.offset_plan import UNITS

    head = ("register", "now", "new", "moves the output", "bias now", "u", "bias after")
    rows = []
    for axis in plan.axes:
        unit, places = UNITS[axis.unit], 2 if axis.unit == "mg" else 3
        moved, bias, after = (
            f"{value:+.{places}f} {unit}" for value in (axis.effect, axis.bias_now, axis.bias_after)
        )
        u = f"{axis.u:.2g} {unit}"
        rows.append((axis.register, str(axis.now), str(axis.new), moved, bias, u, after))
    console().print(table_of(head, rows))
    for axis in plan.axes:
        if axis.clipped:
            click.echo(
                f"{axis.register} holds no more: {axis.bias_after:+.1f} mg of the bias are left",
                err=True,
            )
        if axis.now != axis.recorded:
            click.echo(f"{axis.register} was {axis.recorded} when the session was recorded", err=True)
    for doubt in plan.doubts:
        click.echo(f"doubtful: {doubt}", err=True)


def _tell(text: str) -> None:
    click.echo(text, err=True)
