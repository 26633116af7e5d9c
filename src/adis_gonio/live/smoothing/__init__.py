"""The angle during the turn: gyros and gravity together, by a filter and a smoother with a fixed lag.

`AngleSmoother` takes samples as they come and tells the angle a lag behind them; `smooth` takes a whole
recording. The model is that of `motion`; docs/smoothing.md has it in words.
"""

from adis_gonio.live.smoothing.gyros import GyroKnowledge
from adis_gonio.live.smoothing.increments import Sensing
from adis_gonio.live.smoothing.offline import SmoothedTurn, smooth
from adis_gonio.live.smoothing.smoother import LAG_S, AngleSmoother, SmoothedAngle

__all__ = ["LAG_S", "AngleSmoother", "GyroKnowledge", "Sensing", "SmoothedAngle", "SmoothedTurn", "smooth"]
