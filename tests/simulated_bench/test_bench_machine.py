"""The bench as a state machine of hypothesis: any sequence of commands and faults, shrunk by hypothesis.

Seeds draw stories as they are likely at a bench; hypothesis looks for any sequence that breaks a rule.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from hypothesis import HealthCheck, settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from simulated_bench.bench import LINE_KINDS, LineFault
from simulated_bench.disk import FAILURES, SIDES, DiskFault
from simulated_bench.stories import COMMANDS, Play, Step, Story, tell

disk_faults = st.builds(
    DiskFault,
    st.sampled_from(["kill", "cut", "interrupt", *FAILURES]),
    st.integers(1, 150),
    st.sampled_from(SIDES),
)
line_faults = st.builds(LineFault, st.sampled_from(LINE_KINDS), st.integers(0, 16).map(float), st.just(1.0))


class BenchMachine(RuleBasedStateMachine):
    """A bench with a motor stage; each rule is one command."""

    play: Play | None = None

    @initialize(seed=st.integers(0, 50), streams=st.booleans())
    def begin(self, seed, streams):
        self.outer = tempfile.TemporaryDirectory()
        folder = Path(self.outer.name) / "bench"
        folder.mkdir()
        self.play = Play(Story(seed, (), motor=True, streams=streams, only="none"), folder)

    @rule(fault=st.none() | disk_faults)
    def calibrate(self, fault):
        self.play.do(Step("calibrate", disk=fault))

    @rule(fault=line_faults)
    def calibrate_on_a_bad_line(self, fault):
        self.play.do(Step("calibrate", line=(fault,)))

    @precondition(lambda self: self.play is not None and self.play.record.readable())
    @rule(command=st.sampled_from(COMMANDS), fault=st.none() | disk_faults)
    def use(self, command, fault):
        self.play.do(Step(command, disk=fault))

    @rule(hours=st.sampled_from([0.2, 8.0]))
    def wait(self, hours):
        self.play.do(Step("night", hours=hours))

    @rule()
    def switch_off_and_on(self):
        self.play.do(Step("power"))

    @invariant()
    def nothing_is_wrong(self):
        if self.play is not None:
            assert not self.play.outcome.wrong, tell(self.play.outcome)

    def teardown(self):
        if self.play is not None:
            try:
                if not self.play.outcome.wrong:
                    self.play.finish()
                self.nothing_is_wrong()
            finally:
                self.outer.cleanup()


TestBench = BenchMachine.TestCase
TestBench.settings = settings(
    max_examples=4, stateful_step_count=4, deadline=None, derandomize=True, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
