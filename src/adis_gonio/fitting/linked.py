"""Poses in space with the turns between them: which links are used, and whether the gyros may be believed.

Links (`gyros.links`) and gravity's length say of the same parameters: χ² of the fit rises by what the links
disagree, with as many degrees of freedom as they bring. Where that is beyond the 99.9 % quantile the link
that disagrees most is left out and the test repeated; where more than a quarter would have to go, or none
is left to test by, the gyros are not believed and the fit is that of gravity alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.counting import counted
from adis_gonio.errors import UsageError
from adis_gonio.estimation.fit import Fit
from adis_gonio.estimation.links import Links
from adis_gonio.estimation.readings import Readings
from adis_gonio.fitting.determination import Determination, determine
from adis_gonio.fitting.noise import Noise, settle
from adis_gonio.model.records import Floats, Session

if TYPE_CHECKING:
    from adis_gonio.calibration.gyros import GyroCalibration
    from adis_gonio.gyros.links import GyroLinks
    from adis_gonio.gyros.prior import GyroPrior

LEAST_POSES = 3
LEVEL = 1e-3
"""Level at which links contradict gravity, as that of a residual beyond the noise."""
MOST_LEFT_OUT = 0.25
"""Share of the links that may be left out; where more disagree it is not the links that are odd."""
FAR_RAD, FAR_SHARE = math.radians(10.0), 0.1
"""Distance between gravity and where a gyro carries it, and its share of the way, at which a link is wrong
whatever the parameters: a bias of 50 mg turns gravity by 3°."""
_PASSES = 4
_SETTLED = 0.05
"""Change of the gyros' parameters, in standard uncertainties of the prior, at which they are settled."""


@dataclass(frozen=True)
class LinkReport:
    """What the turns between poses gave to a fit.

    Attributes
    ----------
    used : int
        Links in the fit; 0 where it is that of gravity alone.
    chi2, dof : float or None, int
        By which the links raise χ², and their degrees of freedom.
    refused : tuple of (int, int, str)
        Turns that were left out: the dwells before and after, and why.
    calibrated : bool
        True where a calibration of the gyros was given, else their data sheet counts.
    why : str
        Why no link is used; empty where some are.
    gained : tuple of str
        Parameters that only the links determine.
    ratio : float or None
        Median of u with links over u without, of the parameters that both determine.
    """

    used: int
    chi2: float | None
    dof: int
    refused: tuple[tuple[int, int, str], ...] = ()
    calibrated: bool = False
    why: str = ""
    gained: tuple[str, ...] = ()
    ratio: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """The value of `links`."""
        return {
            "used": self.used,
            "chi2": self.chi2,
            "dof": self.dof,
            "refused": [{"from": b, "to": a, "why": why} for b, a, why in self.refused],
            "gyros": "calibrated" if self.calibrated else "data sheet",
            "why_none": self.why or None,
            "gained": list(self.gained),
            "u_ratio": self.ratio,
        }

    @property
    def line(self) -> str:
        """All of it in a line."""
        if not self.used:
            return f"turns between the poses are not used: {self.why}"
        told = [f"{counted(self.used, 'turn')} between the poses by the gyros"]
        if self.gained:
            told.append(f"they determine {', '.join(self.gained)}")
        if self.ratio is not None:
            told.append(f"u of the rest is {self.ratio:.2f} of that without, median")
        told.append(f"χ² {self.chi2:.1f} at {counted(self.dof, 'degree')} of freedom")
        left = "; ".join(f"{b} to {a} left out: {why}" for b, a, why in self.refused[:2])
        more = len(self.refused) - 2
        if more > 0:
            left += f"; and {more} more"
        return "; ".join([*told, *([left] if left else [])])


def linked_readings(
    session: Session, readings: Readings, gyros: GyroCalibration | None = None
) -> tuple[Readings, LinkReport | None]:
    """Readings of a session in space with the links that may be believed, and what became of them.

    None, and the readings themselves, where nothing was recorded between the poses. Worked out once a
    session where no calibration is given.

    Raises
    ------
    UsageError
        A calibration of gyros was given for a session that cannot use it.
    """
    if gyros is not None:
        return _linked(session, readings, gyros)
    kept: tuple[Readings, LinkReport | None] | None = vars(session).get("_linked")
    if kept is None:
        kept = _linked(session, readings, None)
        vars(session)["_linked"] = kept
    return kept


def _linked(
    session: Session, readings: Readings, gyros: GyroCalibration | None
) -> tuple[Readings, LinkReport | None]:
    if readings.planar or readings.check.all():
        if gyros is not None:
            raise UsageError("a calibration of gyros serves poses in space; this session has a plane")
        return readings, None
    from adis_gonio.gyros.links import gyro_links
    from adis_gonio.gyros.prior import GyroPrior

    prior = GyroPrior.of_sheet(session.sensor)
    found = gyro_links(session, prior if gyros is None else prior.calibrated(gyros))
    if found is None:
        if gyros is not None:
            raise UsageError(
                "nothing was recorded between the poses: a calibration of gyros is of no use here; record"
                " with calibrate --record-turns"
            )
        return readings, None
    return _judged(readings, found, gyros is not None)


def _judged(readings: Readings, found: GyroLinks, calibrated: bool) -> tuple[Readings, LinkReport]:
    """Links tested on the readings that are fitted."""
    training = readings.training
    if len(training) < LEAST_POSES:
        return readings, _unused("a turn needs poses on both sides, and three of them to be tested", calibrated)
    alone = settle(training)
    if not alone.noise.known:
        return readings, _unused("nothing tells the noise of the poses beside them", calibrated)
    data = alone.noise.applied(training)
    plain = alone.determination
    refused = list(found.refused)
    links = found.at(found.prior.values, training.position.tolist())
    links, far = _without_far(links, plain.fit, training.position)
    refused += far
    allowed = math.floor(MOST_LEFT_OUT * (len(links) + len(far)))
    why = _nothing_to_use(len(links), len(far), allowed, refused)
    left_out = len(far)
    while not why:
        links, linked = _settled(found, links, data, training.position)
        if linked is None:
            why = "the fit with them does not converge"
            break
        chi2 = linked.fit.chi2 - plain.fit.chi2
        dof = _dof(linked) - _dof(plain)
        if dof < 1:
            why = "they are too few to be tested against gravity"
        elif chi2 <= _quantile(dof):
            rows = np.flatnonzero(~readings.check)
            whole = replace(links, before=rows[links.before], after=rows[links.after])
            report = _report(len(links), chi2, dof, refused, calibrated, plain, linked)
            return replace(readings, links=whole), report
        else:
            left_out += 1
            if left_out > allowed or len(links) < 2:
                why = f"they contradict gravity (χ² {chi2:.3g} at {counted(dof, 'degree')} of freedom)"
                break
            worst = _worst(linked.fit)
            pair = links.before[worst], links.after[worst]
            b, a = (int(training.position[k]) for k in pair)
            refused.append((b, a, "it contradicts gravity and the other turns"))
            links = links.only(np.arange(len(links)) != worst)
    return readings, _unused(why, calibrated, refused)


def _unused(
    why: str, calibrated: bool, refused: Sequence[tuple[int, int, str]] = ()
) -> LinkReport:
    return LinkReport(0, None, 0, tuple(refused), calibrated, why)


def _nothing_to_use(
    links: int, far: int, allowed: int, refused: Sequence[tuple[int, int, str]]
) -> str:
    if far > allowed:
        return f"by {far} of {links + far} the gyros turn gravity elsewhere than it is: a wrong sign, axis or range"
    if not links:
        return refused[0][2] if refused else "no turn lies between two poses that are fitted"
    return ""


def _without_far(
    links: Links, fit: Fit, position: Floats
) -> tuple[Links, list[tuple[int, int, str]]]:
    """Links less those that are wrong whatever the parameters are."""
    attitude = fit.settled(4).values.attitude
    came = (links.rotation @ attitude[links.before][:, :, None])[:, :, 0]
    there = attitude[links.after]
    away = np.arctan2(np.linalg.norm(np.cross(came, there), axis=1), (came * there).sum(axis=1))
    turned = np.arccos(np.clip((np.trace(links.rotation, axis1=1, axis2=2) - 1) / 2, -1, 1))
    far = away > np.maximum(FAR_RAD, FAR_SHARE * turned)
    told = [
        (
            int(position[links.before[k]]),
            int(position[links.after[k]]),
            f"the gyros put gravity {math.degrees(away[k]):.0f}° from where it is",
        )
        for k in np.flatnonzero(far).tolist()
    ]
    return links.only(~far), told


def _settled(
    found: GyroLinks, links: Links, data: Readings, position: Floats
) -> tuple[Links, Determination | None]:
    """Fit with links, linearised where the gyros' parameters end up."""
    used = {(int(b), int(a)) for b, a in zip(links.before, links.after, strict=True)}
    size = np.sqrt(np.diagonal(found.prior.covariance))
    values = found.prior.values
    linked = None
    for _ in range(_PASSES):
        whole = found.at(values, position.tolist())
        pairs = zip(whole.before.tolist(), whole.after.tolist(), strict=True)
        links = whole.only(np.array([pair in used for pair in pairs]))
        try:
            linked = determine(replace(data, links=links))
        except (np.linalg.LinAlgError, UsageError):
            return links, None
        moved = _gyros_of(linked.fit, found.prior)
        change = float(np.max(np.abs(moved - values) / np.maximum(size, 1e-12)))
        values = moved
        if change < _SETTLED:
            break
    return links, linked


def _gyros_of(fit: Fit, prior: GyroPrior) -> Floats:
    """Parameters of the gyros (21,) that the links of a fit make most likely."""
    links, rows = fit.link_rows, fit.modes
    assert links is not None and rows is not None
    flat = fit.unshared_residual
    count = links.links.modes_rad.shape[2]
    found = np.linalg.solve(np.eye(rows.shape[1]) + rows.T @ rows, rows.T @ flat)
    return np.asarray(prior.values + prior.root @ found[-count:])


def _worst(fit: Fit) -> int:
    """The link whose rows are farthest from what the others say."""
    links = fit.link_rows
    assert links is not None
    rows = fit.residual[-2 * len(links.links) :].reshape(-1, 2)
    return int((rows**2).sum(axis=1).argmax())


def _dof(found: Determination) -> int:
    return found.fit.equations - int(found.free.sum()) + found.null.shape[1]


def _quantile(dof: int) -> float:
    from scipy.special import chdtri

    return float(chdtri(dof, LEVEL))


def _report(
    used: int,
    chi2: float,
    dof: int,
    refused: Sequence[tuple[int, int, str]],
    calibrated: bool,
    plain: Determination,
    linked: Determination,
) -> LinkReport:
    from adis_gonio.fitting.determination import covariance, is_determined

    u = []
    for found in (plain, linked):
        spread = np.sqrt(np.maximum(np.diagonal(covariance(found.fisher, found.free, found.null)), 0.0))
        seen = [found.free[k] and is_determined(row, found.null) for k, row in enumerate(np.eye(len(spread)))]
        u.append(np.where(seen, spread, np.inf))
    both = np.isfinite(u[0]) & np.isfinite(u[1])
    gained = [n for n, a, b in zip(linked.names, u[0], u[1], strict=True) if math.isinf(a) and math.isfinite(b)]
    ratio = float(np.median(u[1][both] / u[0][both])) if both.any() else None
    return LinkReport(used, chi2, dof, tuple(refused), calibrated, "", tuple(gained), ratio)
