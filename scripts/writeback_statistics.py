"""Write the biases of many simulated parts back and see what is left of them.

Each part is calibrated, written, saved and left alone; the truth is the simulator's, in the middle of the
dwell after the write. Prints the bias before and after in LSB of the offset registers, how often the
verification accused a sound part, and whether the flash was written exactly once each.

    python scripts/writeback_statistics.py --parts 200
    python scripts/writeback_statistics.py --parts 50 --variant adis16350 --dwell 5
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.bench.writeback import OffsetWriter, WriteSettings
from adis_gonio.device.sensor import Adis16354
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from adis_gonio.sim import SimBus, World


@dataclass
class Part:
    """One part: true biases (2,) in LSB before and after, and flash writes.

    `u` is that of the fit and of what wanders between the session and now, in LSB.
    """

    before: np.ndarray
    after: np.ndarray
    u: np.ndarray
    endurance: int


def write_back(seed: int, folder: Path, variant: str, plan_name: str, dwell_s: float) -> Part:
    """Calibrate part `seed` and write its biases back."""
    bus = SimBus(World(seed=seed, part=variant), url=f"sim:?seed={seed}")
    sensor, path = Adis16354(bus, variant), folder / f"{seed}.session"
    runner = SessionRunner.begin(sensor, path, plan(plan_name), Settings(dwell_s=dwell_s), auto=True)
    for _ in runner.run(so_far=False):
        pass
    writer = OffsetWriter(sensor, path, WriteSettings(save=True, dwell_s=dwell_s))
    made = writer.plan()
    outcome = writer.write()
    truth = bus.world.truth(np.linspace(bus.now_s() - dwell_s, bus.now_s(), 64))
    lsb = sensor.variant.accel_mg_per_lsb
    bias = np.array([truth["bias_x"], truth["bias_y"]])
    left = bias + lsb * np.array([axis.new for axis in made.axes])
    path.unlink()
    wander = np.sqrt(2) * sensor.variant.performance.bias_instability_mg
    u = np.hypot([axis.u for axis in made.axes], wander)
    return Part(bias / lsb, left / lsb, u / lsb, outcome.endurance_after)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--variant", default="adis16354")
    parser.add_argument("--plan", default="four-position")
    parser.add_argument("--dwell", type=float, default=2.0)
    given = parser.parse_args()
    parts: list[Part] = []
    refused: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(given.first, given.first + given.parts):
            try:
                parts.append(write_back(seed, Path(folder), given.variant, given.plan, given.dwell))
            except AdisGonioError as error:
                refused[f"{type(error).__name__}: {error}"] += 1
    before, after = (np.abs([getattr(p, name) for p in parts]) for name in ("before", "after"))
    print(f"{given.parts} parts {given.variant}, plan {given.plan}, dwells of {given.dwell:g} s")
    print("| bias / LSB | median | 95 % | largest | rms | within 1 LSB |\n|---|---|---|---|---|---|")
    for name, values in (("before", before), ("after", after)):
        rms, share = np.sqrt(np.mean(values**2)), np.mean(values <= 1)
        print(
            f"| {name} | {np.median(values):.2f} | {np.quantile(values, 0.95):.2f} | {values.max():.2f}"
            f" | {rms:.2f} | {100 * share:.1f} % |"
        )
    near = np.mean(after <= 1 + 2 * np.array([p.u for p in parts]))
    print(f"after, within 1 LSB and 2 u of fit and wander: {100 * near:.1f} %")
    print(f"flash writes: {dict(Counter(p.endurance for p in parts))}")
    print(f"refused or set back: {sum(refused.values())}")
    for text, count in refused.items():
        print(f"  {count} x {text.replace(folder, '')}")


if __name__ == "__main__":
    main()
