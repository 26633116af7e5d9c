"""Speed against named baselines, as ratios taken in the same run; `scripts/bench.py` runs it."""
