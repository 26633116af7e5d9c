"""Speed against named baselines, as ratios taken in the same run; `scripts/speed_ratios.py` runs it."""
