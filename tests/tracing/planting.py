"""Effects planted in measured recordings by examples/measured/plant_effect.py, traced and judged."""

import functools
import importlib.util
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adis_gonio import load_session, trace
from recordings import MEASURED

RECORDINGS = ("mimu4444_exp4_imu1", "xsens_mti_recording")
"""Recordings in which `trace` finds at most a bias, with an adequate model."""
OWN = {"bias"}


def _script():
    spec = importlib.util.spec_from_file_location("plant_effect", MEASURED / "plant_effect.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["plant_effect"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


plant_effect = _script()
KINDS = tuple(kind.name for kind in plant_effect.KINDS)


@dataclass(frozen=True)
class Planted:
    """Outcome of one planting: the sealed answer, and what `trace` says of the recording.

    Attributes
    ----------
    found : bool
        The trace reports the planted effect: a credible set of a cause holds its name, or an unnamed
        function of its covariate if it has none; or the samples show its step.
    false : set of str
        Effects called found that are neither in the recording nor planted.
    """

    answer: dict
    document: dict

    @property
    def found(self) -> bool:
        names = {name for one in self.document["sets"] for name in one["names"]}
        if self.answer["catalogued"]:
            return self.answer["kind"] in names
        steps = {axis for one in self.document["within"] if one["kind"] == "step" for axis in one["axes"]}
        stepped = self.answer["kind"] == "jump in time" and self.answer["axis"] in steps
        return stepped or f"unnamed: {self.answer['covariate']}" in names

    @property
    def false(self) -> set[str]:
        return {one["effect"] for one in self.document["found"]} - OWN - {self.answer["kind"]}


@functools.cache
def limits(name: str) -> dict:
    """Return the smallest amplitudes that `trace` states for a recording."""
    return trace(load_session(MEASURED / f"{name}.csv.gz")).as_dict()["detectable"]


@functools.cache
def planted(name: str, kind: str, seed: int) -> Planted | None:
    """Plant one effect in a recording and trace the result; None if the recording cannot show the kind."""
    source = MEASURED / f"{name}.csv.gz"
    samples = plant_effect.Recording.read(source)
    which = KINDS.index(kind)
    rng = np.random.default_rng([seed, which])
    planting = plant_effect.plant(
        samples, load_session(source), limits(name), plant_effect.KINDS[which], rng
    )
    if planting is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "planted.csv.gz"
        samples.write(path, planting.added_mg)
        document = trace(load_session(path)).as_dict()
    return Planted(planting.answer, document)
