"""What a population shows, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import Value


@dataclass(frozen=True)
class Affected(JsonRecord):
    """A session that is probably affected."""

    source: str
    serial: str
    digest: str
    probability: float


@dataclass(frozen=True)
class Common(JsonRecord):
    """A cause that sessions have in common.

    The JSON document is one entry of `found`, `sets` or `unnamed`.

    Attributes
    ----------
    effects : tuple of str
        Names that cannot be told apart, the most probable first; one where it is certain. Empty for what is
        common and has no name.
    depends_on : str
        What it depends on, where it has no name.
    variant : str
        Choice or time constant of the most probable form.
    axes : tuple of str
        Its axes.
    posterior : mapping of str to float
        Of each name, given that there is a cause; what has no name stands as `unnamed: …`.
    by, value : str
        Group that shows it: `all`, or `stage` and which.
    groups : mapping of str to float
        Posterior of the groups that come into question.
    sessions : int
        Sessions of the group that can see it.
    share : mapping of str to float
        Share of these sessions that are affected, as `value`, and its 95 % interval, `low` and `high`.
        If the sign is not common, the interval begins with those that are affected for themselves:
        only the shape of the normal distribution then tells share and spread apart.
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
    axes: tuple[str, ...]
    posterior: Mapping[str, float]
    by: str
    value: str
    groups: Mapping[str, float]
    sessions: int
    share: Mapping[str, float]
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

    def sentence(self) -> str:
        """In one sentence."""
        what = " or ".join(self.effects) if self.effects else f"something that follows {self.depends_on}"
        axes = f" of {', '.join(self.axes)}" if self.axes else ""
        where = "" if self.by == "all" else f" of {self.by} {self.value}"
        sign = "of one sign" if self.common_sign else "of either sign"
        sizes, share = "; ".join(self._size(name) for name in self.mean), self.share
        return (
            f"{what}{axes}: in {share['value']:.0%} ({share['low']:.0%} to {share['high']:.0%}) of"
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
class Reach(JsonRecord):
    """What a population would have shown of an effect.

    The JSON document is one value of `detectable`.

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


@dataclass(frozen=True)
class PopulationResult(JsonRecord):
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
    inflation : mapping of str to float
        `median` and `largest` factor on a session's noise variance.
    notes : tuple of str
    """

    sessions: int
    found: tuple[Common, ...]
    sets: tuple[Common, ...]
    unnamed: tuple[Common, ...]
    detectable: Mapping[str, Reach]
    missing: Mapping[str, str]
    open: Mapping[str, str]
    inflation: Mapping[str, float]
    notes: tuple[str, ...] = ()

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
