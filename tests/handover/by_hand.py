"""The paper's equations written out again, from the theory and nothing else.

Symbols are those of the paper: readings U of X and Y in local gravity, α the start angle, Δφ the
misalignment. No function of the package is called.
"""

from __future__ import annotations

import math


def readings(alpha, k_x, k_y, phi, theta, b_x=0.0, b_y=0.0):
    """U_x and U_y of the planar model at θ; θ = 90° is equation 6."""
    return k_x * math.cos(alpha - theta) + b_x, k_y * math.sin(alpha - theta + phi) + b_y


def paper(u_x1, u_y1, u_x2, u_y2):
    """(ΔK, Δφ in degrees): equation 5 with U_x′ = −U_y2, then 7 to 12 with Y's gain divided out."""
    delta_k = u_x1 / (-u_y2) - 1
    y1, y2 = u_y1 * (1 + delta_k), u_y2 * (1 + delta_k)
    a, b = y1 / u_x1, y2 / u_x2
    return delta_k, math.degrees(math.asin((1 + a * b) / (a + b)))


def mmpm(angles_deg, rows):
    """(ΔK, Δφ in degrees, b_x, b_y) of evenly spaced positions: sums over a turn, no matrix."""
    n = len(angles_deg)
    fitted = []
    for axis in (0, 1):
        values = [row[axis] for row in rows]
        cosine = 2 / n * sum(v * math.cos(math.radians(t)) for v, t in zip(values, angles_deg, strict=True))
        sine = 2 / n * sum(v * math.sin(math.radians(t)) for v, t in zip(values, angles_deg, strict=True))
        fitted.append((cosine, sine, sum(values) / n))
    (a_x, b_x, zero_x), (a_y, b_y, zero_y) = fitted
    phi = math.atan2(a_y, -b_y) - math.atan2(b_x, a_x)
    return math.hypot(a_x, b_x) / math.hypot(a_y, b_y) - 1, math.degrees(phi), zero_x, zero_y
