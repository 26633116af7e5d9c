"""What a population shows, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from adis_gonio.base.jsonable import finite
from adis_gonio.base.numbers import counted
from adis_gonio.base.values import Value


@dataclass(frozen=True)
class Affected:
    """A session that is probably affected."""

    source: str
    serial: str
    digest: str
    probability: float

    def as_dict(self) -> dict[str, Any]:
        """Its fields."""
        return {
            "source": self.source,
            "serial": self.serial,
            "digest": self.digest,
            "probability": self.probability,
        }


@dataclass(frozen=True)
class Common:
    """A cause that sessions have in common.

    Attributes
    ----------
    effects : tuple of str
        Names that cannot be told apart, the most probable first; one where it is certain. Empty for what is
        common and has no name.
    depends_on : str
        What it depends on, where it has no name.
    variant, axes : str
        Choice or time constant, and axes, of the most probable form.
    posterior : mapping of str to float
        Of each name, given that there is a cause; what has no name stands as `unnamed: …`.
    by, value : str
        Group that shows it: `all`, or `stage` and which.
    groups : mapping of str to float
        Posterior of the groups that come into question.
    sessions : int
        Sessions of the group that can see it.
    share : float
        Of them that are affected, with its 95 % interval in `share_low`, `share_high`. Where the sign is
        not common, the interval begins with those that are affected for themselves: share and spread are
        then told apart by the shape of the normal distribution only.
    mean : mapping of str to Value
        Mean amplitude of affected sessions by parameter; zero where its sign is not common.
    spread : mapping of str to float
        Standard deviation of the amplitudes about it, in the same units.
    relative : bool
        True where amplitudes are alike against what each session can show rather than in their unit; `mean`
        and `spread` are then those of a session of median uncertainty among the affected ones.
    p_value : float
        At most this probable where no session has any cause (beside those found before).
    heldout_gain : float
        Log likelihood of sessions that took no part in choosing the cause, against the model without it.
    affected : tuple of Affected
        Sessions affected with a probability above one half, the most probable first.
    """

    effects: tuple[str, ...]
    depends_on: str
    variant: str
    axes: str
    posterior: Mapping[str, float]
    by: str
    value: str
    groups: Mapping[str, float]
    sessions: int
    share: float
    share_low: float
    share_high: float
    mean: Mapping[str, Value]
    spread: Mapping[str, float]
    relative: bool
    p_value: float
    heldout_gain: float
    affected: tuple[Affected, ...] = ()

    @property
    def common_sign(self) -> bool:
        """True where the amplitudes have a mean that differs from zero."""
        return any(value.value != 0 for value in self.mean.values())

    def as_dict(self) -> dict[str, Any]:
        """One entry of `found`, `sets` or `unnamed`."""
        document: dict[str, Any] = finite(
            {
                "effects": self.effects,
                "depends_on": self.depends_on,
                "variant": self.variant,
                "axes": list(self.axes),
                "posterior": self.posterior,
                "by": self.by,
                "value": self.value,
                "groups": self.groups,
                "sessions": self.sessions,
                "share": {"value": self.share, "low": self.share_low, "high": self.share_high},
                "mean": {name: value.as_dict() for name, value in self.mean.items()},
                "spread": self.spread,
                "relative": self.relative,
                "p_value": self.p_value,
                "heldout_gain": self.heldout_gain,
                "affected": [unit.as_dict() for unit in self.affected],
            }
        )
        return document

    def sentence(self) -> str:
        """In one sentence."""
        what = " or ".join(self.effects) if self.effects else f"something that follows {self.depends_on}"
        axes = f" of {', '.join(self.axes)}" if self.axes else ""
        where = "" if self.by == "all" else f" of {self.by} {self.value}"
        sign = "of one sign" if self.common_sign else "of either sign"
        sizes = "; ".join(self._size(name) for name in self.mean)
        return (
            f"{what}{axes}: in {self.share:.0%} ({self.share_low:.0%} to {self.share_high:.0%}) of"
            f" {counted(self.sessions, 'session')}{where}, {sign} ({sizes}); p < {_p(self.p_value)},"
            f" on sessions that took no part the log likelihood gains {self.heldout_gain:.1f}"
        )

    def _size(self, name: str) -> str:
        value, spread = self.mean[name], self.spread[name]
        if not self.common_sign:
            return f"{name} about {spread:.2g} {value.unit}"
        sure = "" if value.U is None else f" ± {value.U:.1g}"
        return f"{name} {value.value:.3g}{sure} {value.unit}, scattering by {spread:.1g}"


def _p(value: float) -> str:
    return f"{max(value, 1e-99):.1g}"


@dataclass(frozen=True)
class Reach:
    """What a population would have shown of an effect.

    Attributes
    ----------
    amplitude : mapping of str to float
        By share of the sessions (`0.1`, `0.3`, `1`) the smallest amplitude, of one sign or not alike, found
        with 90 % power; None where none would have been.
    unit, parameter : str
    """

    amplitude: Mapping[str, float | None]
    unit: str
    parameter: str

    def as_dict(self) -> dict[str, Any]:
        """One value of `detectable`."""
        return {"amplitude": dict(self.amplitude), "unit": self.unit, "parameter": self.parameter}


@dataclass(frozen=True)
class PopulationResult:
    """What many sessions have in common.

    Attributes
    ----------
    sessions : int
    found : tuple of Common
        Causes with one name.
    sets : tuple of Common
        Causes of several names that cannot be told apart.
    unnamed : tuple of Common
        What is common and has no name, or may have none.
    detectable : mapping of str to Reach
    missing : mapping of str to str
        Effects that no session could be asked for, with the reason.
    open : mapping of str to str
        Causes that did not stand, with the reason.
    inflation : tuple of float
        Median and largest factor on a session's noise variance.
    notes : tuple of str
    """

    sessions: int
    found: tuple[Common, ...]
    sets: tuple[Common, ...]
    unnamed: tuple[Common, ...]
    detectable: Mapping[str, Reach]
    missing: Mapping[str, str]
    open: Mapping[str, str]
    inflation: tuple[float, float]
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """JSON."""
        return {
            "sessions": self.sessions,
            "found": [one.as_dict() for one in self.found],
            "sets": [one.as_dict() for one in self.sets],
            "unnamed": [one.as_dict() for one in self.unnamed],
            "detectable": {name: reach.as_dict() for name, reach in self.detectable.items()},
            "missing": dict(self.missing),
            "open": dict(self.open),
            "inflation": {"median": self.inflation[0], "largest": self.inflation[1]},
            "notes": list(self.notes),
        }

    def summary(self) -> tuple[str, ...]:
        """Lines for a reader."""
        lines = [f"Population of {counted(self.sessions, 'session')}:"]
        for title, every in (
            ("found", self.found),
            ("cannot be told apart", self.sets),
            ("no name", self.unnamed),
        ):
            lines += [f"  {title}: {one.sentence()}" for one in every]
        if not (self.found or self.sets or self.unnamed):
            lines.append("  nothing that the sessions have in common")
        lines += [f"  {name} does not stand: {reason}" for name, reason in self.open.items()]
        lines += [f"  {note}" for note in self.notes]
        return tuple(lines)
