"""Every state of the screen, as the events that lead to it."""

from __future__ import annotations

from adis_gonio.bench import events
from adis_gonio.record.plans import extension, plan

PLAN = plan("tumble", 6)
LIMIT = (7.9, 7.9, 7.9)


def started(resumed: bool = False, name: str = "tumble") -> events.Started:
    made = PLAN if name == "tumble" else plan(name)
    return events.Started("today.session", "serial:/dev/ttyACM0", "adis16354", made, resumed, 0)


OPEN = [
    started(),
    events.Configured({"sample_rate_hz": 819.2}, {"SENS_AVG": (0x402, 0x302)}, ""),
    events.NoiseMeasured((1.99, 1.97, 2.04)),
]


def look(
    state: str = "idle",
    angle: float | None = 0.02,
    target: float | None = 0.0,
    spread: float = 2.1,
    waits: str = "an answer",
    temperature: float = 24.6,
    lost: int = 0,
    limit: events.Vector | None = LIMIT,
    tolerance: float | None = 1.2,
) -> events.Watching:
    accel, noise = (1000.0, 3.0, -8.0), (1.9, spread, 2.0)
    return events.Watching(state, accel, noise, angle, target, limit, waits, temperature, lost, tolerance)


def asked(place: int, made=PLAN, left: float = 754.0) -> events.PositionAsked:
    return events.PositionAsked(place, made.positions[place], place + 1, len(made), place > 0, left)


def done(place: int, made=PLAN, alarms: int = 0, lost: int = 0) -> events.DwellDone:
    return events.DwellDone(
        place, made.positions[place], place + 1, 8192, lost, (1010.4, -57.31, -7.92), alarms
    )


TURN = events.TurnMeasured(1, 60.0, 59.84, 0.31, 60.12)
RUNNING = events.Running(
    {
        "delta_k": {"value": 0.00108, "u": 0.00013, "U": 0.00026, "unit": "1"},
        "delta_phi": {"value": -0.4123, "u": 0.0121, "U": 0.0242, "unit": "deg"},
    },
    "ml",
    3,
)
THREE = [*OPEN, look(), asked(0), done(0), asked(1), TURN, done(1), RUNNING, asked(2), done(2), RUNNING]
DWELL = events.DwellProgress(
    3, 4.2, 10.0, events.Watching(
        "recording", (-1000.0, 3.0, -8.0), (1.9, 2.3, 2.0), 180.03, 180.0, LIMIT, "the dwell to end", 25.1
    ),
)  # fmt: skip


def guard(kind: str, message: str, values: dict[str, float], answers: tuple[str, ...], default: str):
    return events.GuardRaised(kind, message, values, answers, default, place=1, position=PLAN.positions[1])


REVERSED = guard(
    "reversed",
    "the part was turned by −59.8°, and +60° was asked for: the wrong way round",
    {"asked_deg": 60.0, "gyro_deg": -59.84, "gravity_deg": -60.12},
    ("retake", "reverse", "keep"),
    "retake",
)
NOT_MOVED = guard(
    "not_moved",
    "nothing has moved since the last position: gravity has turned by 0.01°, 60° was asked for",
    {"asked_deg": 60.0, "gravity_deg": 0.01},
    ("retake", "skip", "keep"),
    "retake",
)
SHOCK = guard(
    "shock",
    "a shock of 214 mg at 3.2 s of the dwell",
    {"shock_mg": 214.0, "at_s": 3.2},
    ("retake", "keep"),
    "retake",
)
TWO = plan()
BLIND = (
    "2 positions cannot see a bias: 50 mg on each axis would put 4.05° into Δφ and 0.0707 into ΔK; the"
    " opposite positions cancel it"
)
EXTENSION = events.ExtensionOffered(extension(TWO, 2), (BLIND,))
LONG = plan("mmpm", 36)
POSES = plan("poses")

STATES: dict[str, tuple[list[events.Event], tuple[str, ...]]] = {
    "opening": ([], ()),
    "measuring": (
        [*OPEN[:2], look("measuring", None, None, limit=None, waits="the part to lie still")],
        (),
    ),
    "first_position": ([*OPEN, asked(0), look(angle=-3.3)], ()),
    "first_position_held": ([*OPEN, asked(0), look(angle=-3.3)], ("x",)),
    "turn_more": ([*THREE, asked(3), look(angle=147.2, target=180.0)], ()),
    "turn_back": ([*THREE, asked(3), look(angle=183.4, target=180.0, lost=2)], ()),
    "there": ([*THREE, asked(3), look(angle=180.01, target=180.0)], ()),
    "moving": ([*THREE, asked(3), look("moving", 171.0, 180.0, 55.3, "rest: y varies by 55.3 mg")], ()),
    "settling": ([*THREE, asked(3), look("settling", 180.0, 180.0, waits="the part to settle")], ()),
    "dwell": ([*THREE, asked(3), DWELL], ()),
    "waiting": ([*THREE, asked(3), events.Waiting(3, 61.0, 600.0)], ()),
    "interrupted": (
        [
            *THREE, asked(3), DWELL,
            events.DwellInterrupted(
                3, PLAN.positions[3], 4, 3440, "y varies by 31 mg, at rest at most 7.9 mg"
            ),
            look("moving", 180.2, 180.0, 31.0, "rest: y varies by 31 mg"),
        ],
        (),
    ),
    "paused": ([*THREE, asked(3), events.Paused()], ()),
    "noted": ([*THREE, asked(3), events.Noted("door slammed")], ()),
    "withdrawn": ([*THREE, events.Withdrawn(2, PLAN.positions[2]), asked(2)], ()),
    "fault_and_skip": ([*OPEN, done(0, alarms=3, lost=2), asked(1), done(2), look(angle=0.5)], ()),
    "tracing": ([*THREE, events.Advising(12)], ()),
    "long_plan": ([started(name="mmpm"), *OPEN[1:], look()], ("x",)),
    "pose": (
        [
            events.Started("today.session", "serial:/dev/ttyACM0", "adis16354", POSES, False, 0),
            *OPEN[1:], asked(0, POSES), look(angle=None, target=None),
        ],
        ("x",),
    ),
    "guard_reversed": ([*THREE, REVERSED], ()),
    "guard_not_moved": ([*THREE, NOT_MOVED], ()),
    "guard_shock": ([*THREE, SHOCK], ("down",)),
    "extension": (
        [started(name="two-position"), *OPEN[1:], done(0, TWO), done(1, TWO), EXTENSION],
        (),
    ),
    "quit": ([*THREE, asked(3), look(angle=180.0, target=180.0)], ("q",)),
    "note": ([*THREE, asked(3), look(angle=180.0, target=180.0)], ("n", *"door")),
    "help": ([*THREE, asked(3), look(angle=180.0, target=180.0)], ("question_mark",)),
    "nothing_to_answer": ([*THREE, DWELL], ("enter",)),
}  # fmt: skip
STATES["long_plan"][0][0] = events.Started(
    "today.session", "serial:/dev/ttyACM0", "adis16354", LONG, False, 0
)
STATES["long_plan"][0].append(asked(20, LONG, 7300.0))
