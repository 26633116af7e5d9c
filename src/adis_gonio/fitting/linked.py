"""Links: turns between poses that the gyros measured, tested against gravity and added to a fit.

Links (`gyros.gyro_links`) and the length of gravity determine the parameters together. Links that disagree
with gravity raise χ² of the fit; the rise is tested with the degrees of freedom that the links add. If it
is above the 99.9 % quantile, the link that disagrees most is removed and the test is repeated. If more than
a quarter of the links would be removed, or no link remains, no link is used and the fit uses gravity alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import LINK_REFUSED
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting import determination
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.links import Links
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.noise_estimation import chi2_quantile, settle
from adis_gonio.model.records import Session

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration
    from adis_gonio.fitting.gyros.gyro_links import GyroLinks, GyroPrior

Refused = tuple[int, int, str]
LEAST_POSES = 3
"""Fewest poses for a fit with links: two turns give four equations for nine parameters of the
accelerometers and for the parameters of the gyros.
"""
MOST_LEFT_OUT = 0.25
"""Largest share of links that may be removed; if more disagree, the gyros as a whole are wrong."""
FAR_RAD, FAR_SHARE = math.radians(10.0), 0.1
"""Limits of the angle between gravity and its prediction by the gyros: in rad, and as a share of the turn's
angle. A link above both is wrong for any parameters: a bias of 50 mg turns gravity by only 3°."""
_SETTLED = 0.05
"""Change of the gyros' parameters between two fits, in standard uncertainties of the prior, below which
they have converged."""


@dataclass(frozen=True)
class LinkReport:
    """Effect that links (turns between poses that the gyros measured) have on a fit.

    Attributes
    ----------
    used : int
        Number of links in the fit; 0 if it uses gravity alone.
    chi2, dof : float or None, int
        Increase of χ² by the links, and the degrees of freedom that the links add; `chi2` is None if the
        links could not be tested.
    refused : tuple of (int, int, str)
        Turns that were not used: numbers of the dwells before and after, and the reason.
    calibrated : bool
        True if a calibration of the gyros was given; False if the data sheet is used.
    why : str
        Reason why no link is used; empty if some are.
    gained : tuple of str
        Parameters that only the links determine.
    ratio : float or None
        Median ratio of u with links to u without links, over the parameters that both fits determine; None
        without links or such a parameter.
    missed_deg : float
        Standard uncertainty in degrees of a turn about each axis because of lost samples and motion between
        samples; 0 if the noise of the samples contributes more.
    """

    used: int
    chi2: float | None
    dof: int
    refused: tuple[Refused, ...] = ()
    calibrated: bool = False
    why: str = ""
    gained: tuple[str, ...] = ()
    ratio: float | None = None
    missed_deg: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the report, the value of `links` in a result."""
        return {
            "used": self.used,
            "chi2": self.chi2,
            "dof": self.dof,
            "refused": [{"from": b, "to": a, "why": why} for b, a, why in self.refused],
            "gyros": "calibrated" if self.calibrated else "data sheet",
            "why_none": self.why or None,
            "gained": list(self.gained),
            "u_ratio": self.ratio,
            "missed_deg": self.missed_deg,
        }

    @property
    def line(self) -> str:
        """Summary of the report in one line of text."""
        if not self.used:
            return f"turns between the poses are not used: {self.why}"
        parts = [f"{counted(self.used, 'turn')} between the poses by the gyros"]
        if self.gained:
            parts.append(f"they determine {', '.join(self.gained)}")
        if self.ratio is not None:
            of = "u of the others" if self.gained else "u with them"
            parts.append(f"{of} is {self.ratio:.2f} of that without, median")
        parts.append(f"χ² {self.chi2:.1f} at {counted(self.dof, 'degree')} of freedom")
        if self.missed_deg:
            parts.append(f"the samples miss fast motion, {self.missed_deg:.2g}° of a turn; sample faster")
        left = "; ".join(f"{b} to {a} left out: {why}" for b, a, why in self.refused[:2])
        more = len(self.refused) - 2
        if more > 0:
            left += f"; and {more} more"
        return "; ".join([*parts, *([left] if left else [])])


def linked_readings(
    session: Session, gyros: GyroCalibration | None = None
) -> tuple[Readings, LinkReport | None]:
    """Add the links that agree with gravity to the readings of a session in space, and report on all links.

    The second value is None, and the readings are returned unchanged, if nothing was recorded between the
    poses. `gyros` is a calibration from another session; without it the data sheet is used, and the result
    is computed only once for each session.

    Raises
    ------
    UsageError
        A calibration of gyros was given for a session that cannot use it.
    """
    return session.once(_linked) if gyros is None else _linked(session, gyros)


def _linked(session: Session, gyros: GyroCalibration | None = None) -> tuple[Readings, LinkReport | None]:
    readings = readings_of(session)
    if readings.planar or readings.check.all():
        if gyros is not None:
            raise UsageError("a calibration of gyros is for poses in space; this session has a plane")
        return readings, None
    from adis_gonio.fitting.gyros.gyro_links import GyroPrior, gyro_links

    prior = GyroPrior.of_sheet(session.sensor)
    found = gyro_links(session, prior if gyros is None else prior.calibrated(gyros))
    if found is None:
        if gyros is not None:
            raise UsageError(
                "nothing was recorded between the poses: a calibration of gyros is of no use here; record"
                " with calibrate --record-turns"
            )
        return readings, None
    try:
        links, report = judge_links(readings.training, found)
    except (np.linalg.LinAlgError, UsageError):  # with few poses the fit can run to impossible axes
        links, report = None, LinkReport(0, None, 0, found.refused, why="a fit with them does not converge")
    report = replace(report, calibrated=gyros is not None)
    if links is None:
        return readings, report
    # Links are numbered among the fitted readings: renumber them among all readings.
    rows = np.flatnonzero(~readings.check)
    links = replace(links, before=rows[links.before], after=rows[links.after])
    return replace(readings, links=links), report


def judge_links(readings: Readings, found: GyroLinks) -> tuple[Links | None, LinkReport]:
    """Compare the gyros' links with gravity, and remove the worst link until the others agree with it.

    Return the accepted links between these readings, and a report. The links are None if too many disagree
    or if they cannot be tested; the report then has the reason.
    """
    refused = list(found.refused)

    def none(why: str, chi2: float | None = None, dof: int = 0) -> tuple[None, LinkReport]:
        return None, LinkReport(0, chi2, dof, tuple(refused), why=why)

    if len(readings) < LEAST_POSES:
        return none("poses are too few to test them by")
    alone = settle(readings)
    if not alone.noise.known:
        return none("the noise of the poses is unknown")
    data, plain = alone.noise.applied(readings), alone.determination
    position = readings.position
    links = found.at(found.prior.values, position.tolist())
    near = _near(links, plain.fit)
    count, far = len(links), int((~near).sum())
    allowed = math.floor(MOST_LEFT_OUT * count)
    refused += [(*_ends(links, position, int(k)), _FAR) for k in np.flatnonzero(~near)]
    if far > allowed:
        return none(f"in {far} of {count} {_FAR}: a wrong sign, axis, range or unit")
    links = links.only(near)
    left_out = far
    while len(links):
        links, linked = _settled(found, links, data)
        chi2, dof = linked.fit.chi2 - plain.fit.chi2, linked.dof - plain.dof
        if dof < 1:
            return none("they are too few to be tested against gravity")
        if chi2 <= chi2_quantile(dof, LINK_REFUSED):
            gained, ratio = _gain(plain, linked)
            report = LinkReport(len(links), chi2, dof, tuple(refused), gained=gained, ratio=ratio)
            return links, replace(report, missed_deg=found.missed_deg)
        if left_out >= allowed:
            rows = linked.fit.link_rows
            assert rows is not None
            # The misclosure is relative to the prior; its offset leads back to the linearisation's gyros.
            off = np.degrees(rows.misclosure + (rows.turned @ rows.links.offset_rad[:, :, None])[:, :, 0])
            reason = (
                f"they contradict gravity (χ² {chi2:.3g} at {counted(dof, 'degree')} of freedom):"
                f" {np.sqrt((off**2).mean()):.2g}° rms, at most {np.abs(off).max():.2g}°"
            )
            return none(reason, chi2, dof)
        worst = _worst(linked.fit)
        refused.append((*_ends(links, position, worst), "it contradicts gravity and the other turns"))
        links = links.only(np.arange(len(links)) != worst)
        left_out += 1
    return none(refused[0][2] if refused else "none lies between two poses that are fitted")


_FAR = "the gyros turn gravity to a wrong direction"


def _ends(links: Links, position: NDArray[np.intp], link: int) -> tuple[int, int]:
    """Return the numbers of the two dwells that a link connects.

    `link` is the index of the link, `position` (n,) are the numbers of the dwells.
    """
    return int(position[links.before[link]]), int(position[links.after[link]])


def _near(links: Links, fit: Fit) -> NDArray[np.bool_]:
    """Return a mask (m,) of the links that agree roughly with gravity before and after their turn.

    The other links are too wrong for any parameters of gyros and accelerometers to explain: they disagree
    by more than `FAR_RAD` and by more than `FAR_SHARE` of the turn's angle.
    """
    attitude = fit.settled(4).values.attitude
    # Gravity before the turn, carried by the gyros, against gravity after it.
    came = (links.rotation @ attitude[links.before][:, :, None])[:, :, 0]
    there = attitude[links.after]
    away = np.arctan2(np.linalg.norm(np.cross(came, there), axis=1), (came * there).sum(axis=1))
    # Angle of a rotation from its trace: 1 + 2 cos θ.
    turned = np.arccos(np.clip((np.trace(links.rotation, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return np.asarray(away <= np.maximum(FAR_RAD, FAR_SHARE * turned))


def _settled(found: GyroLinks, links: Links, data: Readings) -> tuple[Links, determination.Determination]:
    """Fit readings with links, and linearise the links at the fitted gyro parameters until these settle.

    Return the links, linearised at the last parameters, and the fit.
    """
    size = np.maximum(np.sqrt(np.diagonal(found.prior.covariance)), 1e-12)
    values = found.prior.values
    linked = determination.determine(replace(data, links=links))
    for _ in range(4):
        moved = probable_gyros(linked.fit, found.prior)
        if float(np.max(np.abs(moved - values) / size)) < _SETTLED:
            break
        values = moved
        moved_links = found.at(values, data.position.tolist())
        wanted = set(zip(links.before.tolist(), links.after.tolist(), strict=True))
        pairs = zip(moved_links.before.tolist(), moved_links.after.tolist(), strict=True)
        links = moved_links.only(np.array([pair in wanted for pair in pairs]))
        linked = determination.determine(replace(data, links=links))
    return links, linked


def probable_gyros(fit: Fit, prior: GyroPrior) -> Floats:
    """Return the most probable parameters (21,) of the gyros, given a fit with links and their prior."""
    links, rows = fit.link_rows, fit.modes
    assert links is not None
    assert rows is not None
    flat = fit.unshared_residual
    count = links.links.modes_rad.shape[2]
    # Posterior mean of the shared modes with unit prior; the gyros' modes are the last ones.
    found = np.linalg.solve(np.eye(rows.shape[1]) + rows.T @ rows, rows.T @ flat)
    return np.asarray(prior.values + prior.root @ found[-count:])


def _worst(fit: Fit) -> int:
    """Return the index of the link with the largest residual."""
    links = fit.link_rows
    assert links is not None
    # The last rows of the residual belong to the links, two for each.
    rows = fit.residual[-2 * len(links.links) :].reshape(-1, 2)
    return int((rows**2).sum(axis=1).argmax())


def _gain(
    plain: determination.Determination, linked: determination.Determination
) -> tuple[tuple[str, ...], float | None]:
    """Compare the uncertainties of the fits without links (`plain`) and with links.

    Return the names of the parameters that only the fit with links determines, and the median ratio of u
    with links to u without links, None if the fits have no parameter in common.
    """
    without, together = _u_of(plain), _u_of(linked)
    names = zip(linked.names, without, together, strict=True)
    gained = tuple(name for name, a, b in names if math.isinf(a) and math.isfinite(b))
    both = np.isfinite(without) & np.isfinite(together)
    return gained, float(np.median(together[both] / without[both])) if both.any() else None


def _u_of(found: determination.Determination) -> Floats:
    """Return the standard uncertainty (p,) of the parameters in natural units; inf for undetermined ones.

    It includes the data-sheet figure for skews that are taken as zero, as the u of a result does.
    """
    variance = np.maximum(np.diagonal(determination.covariance(found.fisher, found.free, found.null)), 0.0)
    sensor = found.fit.data.sensor
    skew_u_rad = VARIANTS[sensor].performance.skew_u_rad if sensor in VARIANTS else 0.0
    for k in found.held:
        variance = variance + (skew_u_rad * determination.shift_by_held(found, k)) ** 2
    rows = enumerate(np.eye(len(variance)))
    seen = [bool(found.free[k]) and determination.is_determined(row, found.null) for k, row in rows]
    return np.where(seen, np.sqrt(variance), np.inf)
