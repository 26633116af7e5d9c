"""Advice on further measurements, in sentences; the module `proposals` chooses the measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from adis_gonio.base.numbers import format_duration, join_words
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.model.effects import AXES, catalogue
from adis_gonio.model.effects.gyro_terms import WHOLE_TURNS
from adis_gonio.model.effects.stage_terms import BETWEEN
from adis_gonio.tracing.findings import cycles_alike
from adis_gonio.tracing.proposals import LEAST_SEPARATION, propose
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.trace_result import NextDwell

PLAIN = 100.0
"""Expected difference in standard uncertainties above which a sentence states only "more than"."""


def advise(
    data: Readings,
    selection: Selection,
    terms: Sequence[Term],
    confounded: Sequence[Sequence[str]],
) -> tuple[tuple[str, ...], tuple[NextDwell, ...]]:
    """Return advice for the next measurements, as sentences and as dwells, the most informative first.

    Parameters
    ----------
    data : Readings
        Readings of all dwells.
    selection : Selection
        Model chosen from the fitted dwells, with its rivals.
    terms : sequence of Term
        All candidate terms of the session.
    confounded : sequence of sequences of str
        Groups of names of effects that the session cannot distinguish.
    """
    measurements = tuple(replace(m, sentence=_sentence([m])) for m in propose(data, selection, terms))
    lines = list(sentences(measurements))
    strong = [m for m in measurements if m.purpose == "decide" and m.separation >= LEAST_SEPARATION]
    decided = {name for m in strong for name in (*m.one, *m.other)}
    inside = {term.name for term in selection.terms}
    remedies = {
        name: (not data.planar and kind.remedy_in_space) or kind.remedy
        for name, kind in catalogue(data.model.part).items()
        if kind.remedy
    }
    groups = [c for c in confounded if c[0] in inside or not selection.adequate]
    lines += _by_hand(groups, decided, remedies, alone=not data.model.freedom)
    lines += _of_cycles(selection)
    lines += _of_unnamed(selection.terms)
    lines += _not_recorded(selection.data)
    if not selection.adequate and not lines:
        lines.append(
            "repeat each position at another time and from the other side: the residual is larger than "
            "the noise of the readings, and no single cause explains it"
        )
    return tuple(lines), measurements


def sentences(measurements: Sequence[NextDwell]) -> tuple[str, ...]:
    """Return the proposed measurements as sentences; one sentence lists the dwells with one purpose."""
    return tuple(_sentence(group) for group in _grouped(measurements))


def place(measurement: NextDwell) -> str:
    """Describe a proposed dwell, such as `45° from above, after waiting 5 min`."""
    waiting = f", after waiting {format_duration(measurement.wait_s)}" if measurement.wait_s else ""
    return where(measurement) + waiting


def where(measurement: NextDwell) -> str:
    """Describe a proposed dwell by its angle or attitude alone, such as `45° from above`."""
    if measurement.angle_deg is not None:
        side = " from above" if measurement.approach < 0 else ""
        return f"{measurement.angle_deg:g}°{side}"
    parts = enumerate(measurement.direction or ())
    axes = [f"{'+' if part > 0 else '−'}{AXES[k]}" for k, part in parts if abs(part) > 0.3]
    return f"an attitude that reads {' '.join(axes)}"


def _grouped(measurements: Sequence[NextDwell]) -> list[list[NextDwell]]:
    """Group proposed dwells by the question that they answer.

    A group separates one pair of hypotheses, shows effects that are not yet visible, or consists of all
    dwells that separate hypotheses only faintly.
    """
    groups: dict[object, list[NextDwell]] = {}
    for m in measurements:
        key: object = (m.one, m.other)
        if m.purpose == "cover":
            key = "cover"
        elif m.separation < LEAST_SEPARATION:
            key = "faint"
        groups.setdefault(key, []).append(m)
    return list(groups.values())


def _sentence(group: Sequence[NextDwell]) -> str:
    """Return one sentence that proposes all dwells of a group, which answer the same question."""
    first, what = group[0], _listed([place(m) for m in group])
    if first.purpose == "cover":
        names = list(dict.fromkeys(name for m in group for name in (*m.one, *m.other)))
        return f"measure at {what}: only then could {join_words(names)} be seen, if there"
    strongest = max(m.separation for m in group)
    if strongest < LEAST_SEPARATION:
        return _faint(group)
    figure = f"more than {PLAIN:.0f}" if strongest > PLAIN else f"about {strongest:.0f}"
    apart = f"expected difference {figure} standard uncertainties"
    one, other = (join_words(names) for names in (first.one, first.other))
    if not one or not other:
        return f"measure at {what}: that shows whether {one or other} is there ({apart})"
    return f"measure at {what}: that tells {one} from {other} ({apart})"


def _faint(group: Sequence[NextDwell]) -> str:
    """Return the advice to repeat the positions of `group`, if no single dwell separates the hypotheses."""
    where = _listed(list(dict.fromkeys(place(m) for m in group)))
    # Effects that only one of the two compared models contains.
    names = join_words(list(dict.fromkeys(name for m in group for name in sorted({*m.one} ^ {*m.other}))))
    strongest = max(m.separation for m in group)
    return (
        f"no single position distinguishes {names}; the best positions are {where}, each several times in "
        f"the course of the session (a dwell differs there by {strongest:.1f} standard uncertainties of "
        "the residual)"
    )


def _listed(places: Sequence[str]) -> str:
    return join_words(places, comma="; " if any("," in words for words in places) else ", ")


def _by_hand(
    confounded: Sequence[Sequence[str]],
    decided: set[str],
    remedies: Mapping[str, str],
    *,
    alone: bool,
) -> list[str]:
    """Return actions of the operator that distinguish confounded effects which no further dwell separates.

    Parameters
    ----------
    confounded : sequence of sequences of str
        Groups of effects that the session cannot distinguish; the first of each group is in the model.
    decided : set of str
        Effects that a proposed dwell decides, which need no action.
    remedies : mapping of str to str
        Action by effect.
    alone : bool
        True if the readings have no attitude that a further dwell could change. If no rival in a group has
        an action, the action for the effect in the model is then returned.
    """
    to_do: dict[str, list[str]] = {}
    for names in confounded:
        # The first name is in the model; if it is alone in its group it has no named rival.
        rivals = names[1:] or names
        if alone and not any(name in remedies for name in rivals):
            rivals = names[:1]
        for name in rivals:
            if (
                name in remedies
                and name not in decided
                and name not in to_do.setdefault(remedies[name], [])
            ):
                to_do[remedies[name]].append(name)
    return [
        f"to confirm or rule out {join_words(names)}: {remedy}" for remedy, names in to_do.items() if names
    ]


def _of_cycles(selection: Selection) -> list[str]:
    """Return advice on angles that separate the found periodic stage error from others that fit as well.

    At the session's angles, stage errors with different numbers of cycles per turn can look alike. Each
    line advises additional angles that distinguish them.
    """
    return [
        f"to tell {cycles} cycles a turn from {join_words([str(n) for n in others])}: {BETWEEN}"
        for cycles, others in cycles_alike(selection)
    ]


_FORM_SHOWS = {
    "angle": BETWEEN,
    "reading": BETWEEN,
    "time": "repeat one position many times over a session of this length",
    "order": "repeat one position many times over a session of this length",
    "temperature": "repeat one position while the temperature goes slowly up and down",
    "temperature_rate": "repeat one position while the temperature changes at different speeds",
    "supply": "repeat one position at a dozen supply voltages",
    "line_frequency": "find what moves the line, such as a temperature, and record it",
    "approach": "approach one position from both sides several times",
    "previous_angle": "approach one position from many others",
    "variance": "repeat one position with a source of vibration of different strengths",
    "force": "add poses between those of this session, with each axis along and against gravity",
    "rotation": "turn the part slowly and briskly, to both sides",
}
"""Action that shows the form of an unnamed cause, by the covariate on which the cause depends."""


def _of_unnamed(model: Sequence[Term]) -> list[str]:
    """Return actions that show how the model's unnamed terms depend on covariates, one line each."""
    covariates = dict.fromkeys(c for term in model if term.name is None for c in term.covariates)
    to_do = dict.fromkeys(_FORM_SHOWS[name] for name in covariates if name in _FORM_SHOWS)
    return [f"to see the form of the unnamed part: {what}" for what in to_do]


def _not_recorded(data: Readings) -> list[str]:
    """Return advice to record conditions that are missing from the session, one line each."""
    c = data.conditions
    lines = []
    if data.planar and c.angle_rad is None:
        lines.append(
            "declare the angles of the stage: without them no effect of the stage can be looked for"
        )
    elif data.planar and c.approach is None:
        lines.append(
            "record from which side each position was reached, and approach several from both: backlash "
            "and hysteresis show in nothing else"
        )
    if c.temperature_c is None:
        lines.append("record the temperature: without it no thermal effect can be looked for")
    if "rotation" in data.model.driven_by and c.rate_dps is None:
        lines.append(f"{WHOLE_TURNS}: without turns nothing is known of gains and directions")
    return lines
