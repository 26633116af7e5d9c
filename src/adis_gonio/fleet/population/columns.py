"""Columns of a population trace: what every session is asked about, in the same terms.

An effect of the catalogue is asked for by one column for each amplitude, axis by axis; time constants stand
on one grid in seconds for all sessions, since a part's τ does not know how long a session was. Beside them
stand functions without a name (courses in time, harmonics of gravity's direction in the part, what the
position before leaves), so that a cause that the catalogue lacks is not given the nearest name.

Left out: bias and base parameters (every session has its own), and effects of one dwell: dwell 7 of one
session is no other session's dwell 7.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Basis, NamedTerm, NamelessTerm, Term
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, catalogue
from adis_gonio.tracing.named_candidates import cycles_shown

TAUS_S = tuple(float(f"{tau:.3g}") for tau in np.geomspace(10.0, 3160.0, 11))
"""Time constants, a quarter of a decade apart: between two a course loses less than 1 % of its square."""
MOST_CYCLES = 12
"""Most cycles a turn of a stage that are asked for."""
HARMONICS = (2, 3, 4, 5, 6)
"""Harmonics of gravity's direction that stand for a response without a name."""
COURSES = 4
"""Cosines over the session's length that stand for a course in time without a name."""
NUISANCE = ("bias", "position_slip", "outlier_dwell")


@dataclass(frozen=True)
class Column:
    """One amplitude that a session is asked for.

    Attributes
    ----------
    cause : str
        Name of the catalogue, or what a function without a name depends on.
    named : bool
    variant : str
        Choice and time constant: `degree=2`, `cycles=5`, `tau=316`; or the number of a function.
    axes : str
        Axis on which it acts; empty for the stage.
    parameter, unit : str
        Name of the amplitude in the catalogue, and its unit.
    """

    cause: str
    named: bool
    variant: str
    axes: str
    parameter: str
    unit: str

    @property
    def key(self) -> str:
        """Its name among all columns: `warm_up|tau=316|x|warm_up_x|mg`, `~time|2|x|2_x|mg`."""
        mark = "" if self.named else "~"
        return "|".join([mark + self.cause, self.variant, self.axes, self.parameter, self.unit])

    @property
    def weight(self) -> float:
        """Size expected beside the others of its cause: a random walk has 1/k of cosine k in time."""
        return 1.0 if self.named or self.cause != "time" else 1 / int(self.parameter.split("_")[0])

    @classmethod
    def of(cls, key: str) -> Column:
        """The column of a key; `ValueError` where it is none."""
        cause, variant, axes, parameter, unit = key.split("|")
        return cls(cause.removeprefix("~"), not cause.startswith("~"), variant, axes, parameter, unit)


def columns_of(data: Readings) -> tuple[list[tuple[Term, list[Column]]], dict[str, str]]:
    """Terms with their columns, one a column of the term, and why other effects have none."""
    missing: dict[str, str] = {}
    out: list[tuple[Term, list[Column]]] = []
    for name, kind in catalogue("accelerometer").items():
        reason = _why_not(kind, data)
        if reason:
            missing[name] = reason
            continue
        for variant, effect, shapes in _variants(kind, data):
            term = NamedTerm("", kind.covariates, 0.0, effect, shapes)
            parameters = [effect.parameters[k] for k in term.amplitudes]
            chosen = list(range(len(parameters)))
            if "degree" in kind.choices():
                chosen = chosen[-1:]  # lower powers are columns already
            made = [
                Column(name, True, variant, "".join(effect.axes), parameters[k].name, parameters[k].unit)
                for k in chosen
            ]
            out.append((_Part(term, chosen) if len(chosen) < len(parameters) else term, made))
    out += list(_nameless(data))
    return out, missing


def _why_not(kind: type[Effect], data: Readings) -> str:
    if kind.name in NUISANCE:
        return "every session has its own"
    if kind.enters is Enters.SAMPLES or kind.within_dwell:
        return "it stands among the samples of a dwell"
    if "dwell" in kind.choices():
        return "an effect of one dwell belongs to one session"
    lacking = data.conditions.lacks(kind.needs)
    if lacking:
        return f"{', '.join(lacking)} not recorded"
    if kind.enters is Enters.ATTITUDE and not data.planar:
        return "attitudes are free"
    return ""


def _variants(
    kind: type[Effect], data: Readings
) -> Iterator[tuple[str, Effect, tuple[tuple[int, float], ...]]]:
    options: list[dict[str, int]] = [{}]
    if "degree" in kind.choices():
        options = [{"degree": k} for k in (1, 2, 3)]
    elif "cycles" in kind.choices():
        shown = cycles_shown(data.conditions.covariate("angle_rad"), MOST_CYCLES)
        options = [{"cycles": k} for k in shown]
    for axes in [(letter,) for letter in AXES[: data.axes]] if kind.by_axis else [()]:
        for option in options:
            effect = kind(axes, **option)
            variant = ",".join(f"{key}={value}" for key, value in option.items())
            shaped = [(k, p) for k, p in enumerate(effect.parameters) if p.shape]
            if not shaped:
                yield variant, effect, ()
            elif len(shaped) == 1 and shaped[0][1].unit == "s":
                for tau in TAUS_S:
                    yield f"tau={tau:g}", effect, ((shaped[0][0], tau),)
            else:
                yield variant, effect, tuple((k, p.typical) for k, p in shaped)


class _Part(NamedTerm):
    """A named term of which some amplitudes only are asked for."""

    def __init__(self, term: NamedTerm, chosen: list[int]) -> None:
        super().__init__(term.label, term.covariates, term.cost, term.effect, term.shapes)
        object.__setattr__(self, "_chosen", chosen)

    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Columns of the chosen amplitudes."""
        chosen: list[int] = self._chosen  # type: ignore[attr-defined]
        return super().columns(ideal, conditions)[..., chosen]


def _nameless(data: Readings) -> Iterator[tuple[Term, list[Column]]]:
    """Functions without a name, each axis by itself."""
    conditions = data.conditions
    for cause, gain, basis in _functions(conditions, data.planar):
        probe = (
            basis.common(conditions) if basis.common is not None else basis.by_axis(data.mean / 1000.0, 0)  # type: ignore[misc]
        )
        count = probe.shape[1]
        for k, letter in enumerate(AXES[: data.axes]):
            term = NamelessTerm("", (cause,), 0.0, "gain" if gain else "bias", (k,), basis)
            unit = "mg/g" if gain else "mg"
            head, *number = basis.form.split()
            variant = " ".join(["gain"] * gain + number) or head
            yield (
                term,
                [Column(cause, False, variant, letter, f"{j + 1}_{letter}", unit) for j in range(count)],
            )


def _functions(conditions: Conditions, planar: bool) -> Iterator[tuple[str, bool, Basis]]:
    def over(*rows: Floats) -> Basis:
        kept = np.stack(rows, axis=1)
        return Basis("course", (), common=lambda _: kept)

    time = conditions.time_s
    x = (time - time.min()) / max(float(np.ptp(time)), 1e-9)
    yield "time", False, over(*(np.cos(k * np.pi * x) for k in range(1, COURSES + 1)))
    yield "time", True, over(*(np.cos(k * np.pi * x) for k in (1, 2)))
    for name, rows, scale in (
        ("temperature", conditions.temperature_c, 10.0),
        ("supply", conditions.supply_v, 0.1),
    ):
        if rows is not None and np.ptp(rows) > 0:
            centred = (rows - rows.mean()) / scale
            # Lines have names.
            yield name, False, over(centred**2)
            yield name, True, over(centred**2)
    previous = conditions.previous_angle_rad
    if previous is not None and np.isfinite(previous).all():
        yield "previous angle", False, over(np.cos(previous), np.sin(previous))
    if planar:
        for n in HARMONICS:
            yield "angle", False, Basis(f"harmonic {n}", (), by_axis=_harmonic(n))


def _harmonic(n: int) -> Callable[[Floats, int], Floats]:
    """Harmonic n of gravity's direction in the part, (rows, 2)."""

    def waves(ideal_g: Floats, _: int) -> Floats:
        psi = n * np.arctan2(ideal_g[:, 1], ideal_g[:, 0])
        return np.stack([np.cos(psi), np.sin(psi)], axis=1)

    return waves
