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
    # Stage errors with different numbers of cycles per turn can look alike at the session's angles.
    lines += [
        f"to tell {cycles} cycles a turn from {join_words([str(n) for n in others])}: {BETWEEN}"
        for cycles, others in cycles_alike(selection)
    ]
    lines += _not_recorded(selection.data)
    if not selection.adequate and not lines:
        lines.append(
            "repeat each position at another time and from the other side: the residual is larger than "
            "the noise of the readings, and no single cause explains it"
        )
    return tuple(lines), measurements


def sentences(measurements: Sequence[NextDwell]) -> tuple[str, ...]:
    """Return the proposed measurements as sentences; one sentence lists the dwells with one purpose."""
    groups: dict[object, list[NextDwell]] = {}
    for m in measurements:
        # A group separates one pair of hypotheses, or shows effects that are not yet visible.
        groups.setdefault("cover" if m.purpose == "cover" else (m.one, m.other), []).append(m)
    return tuple(map(_sentence, groups.values()))


def place(measurement: NextDwell) -> str:
    """Describe a proposed dwell, such as `45° from above, after waiting 5 min`."""
    if measurement.angle_deg is not None:
        where = f"{measurement.angle_deg:g}°" + (" from above" if measurement.approach < 0 else "")
    else:
        parts = enumerate(measurement.direction or ())
        axes = [f"{'+' if part > 0 else '−'}{AXES[k]}" for k, part in parts if abs(part) > 0.3]
        where = f"an attitude that reads {' '.join(axes)}"
    waiting = f", after waiting {format_duration(measurement.wait_s)}" if measurement.wait_s else ""
    return where + waiting


def _sentence(group: Sequence[NextDwell]) -> str:
    """Return one sentence that proposes all dwells of a group, which answer the same question."""
    first, places = group[0], list(dict.fromkeys(map(place, group)))
    what = join_words(places, comma="; " if any("," in words for words in places) else ", ")
    if first.purpose == "cover":
        names = list(dict.fromkeys(name for m in group for name in (*m.one, *m.other)))
        return f"measure at {what}: only then could {join_words(names)} be seen, if there"
    strongest = max(m.separation for m in group)
    figure = f"more than {PLAIN:.0f}" if strongest > PLAIN else f"about {strongest:.{int(strongest < 1)}f}"
    apart = f"expected difference {figure} standard uncertainties"
    one, other = (join_words(names) for names in (first.one, first.other))
    shows, tells = ("shows", "tells") if strongest >= LEAST_SEPARATION else ("may show", "may tell")
    if not one or not other:
        return f"measure at {what}: that {shows} whether {one or other} is there ({apart})"
    return f"measure at {what}: that {tells} {one} from {other} ({apart})"


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
    to_do: dict[str, dict[str, None]] = {}
    for names in confounded:
        # The first name is in the model; if it is alone in its group it has no named rival.
        rivals = names[1:] or names
        if alone and not any(name in remedies for name in rivals):
            rivals = names[:1]
        for name in rivals:
            if name in remedies and name not in decided:
                to_do.setdefault(remedies[name], {})[name] = None
    return [f"to confirm or rule out {join_words([*names])}: {remedy}" for remedy, names in to_do.items()]


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
