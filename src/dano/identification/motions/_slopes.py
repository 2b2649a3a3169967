"""How fast values change, by the parabola through those of some frames."""

import numpy as np


def slope(times: np.ndarray, values: np.ndarray, when: float, frames: int) -> np.ndarray:
    """Derivative at a time of the parabola through the nearest known values; a line through only two."""
    nearest = _nearest(times, values, when, frames)
    if len(nearest) < 2:
        return np.full(values.shape[1], np.nan)
    terms, reach = _parabola(times[nearest], when)
    return np.linalg.lstsq(terms, values[nearest], rcond=None)[0][1] / reach


def slope_deviation(times: np.ndarray, values: np.ndarray, when: float, frames: int) -> float:
    """By how much `slope` may be off; values (n, 6), the last three columns the deviations of the first."""
    nearest = _nearest(times, values, when, frames)
    if len(nearest) < 2:
        return float("nan")
    terms, reach = _parabola(times[nearest], when)
    known, widths = values[nearest, :3], values[nearest, 3:]
    free = len(nearest) - terms.shape[1]
    away = known - terms @ np.linalg.lstsq(terms, known, rcond=None)[0]
    scatter = float(np.sum(away**2)) / (3 * free) if free else 0.0
    variance = max(scatter, float(np.mean(widths**2)))
    return float(np.sqrt(variance * np.linalg.inv(terms.T @ terms)[1, 1])) / reach


def _nearest(times: np.ndarray, values: np.ndarray, when: float, frames: int) -> np.ndarray:
    """Frames nearest to a time of which values are known."""
    known = np.flatnonzero(np.isfinite(values).all(axis=1))
    return known[np.argsort(np.abs(times[known] - when), kind="stable")[:frames]]


def _parabola(times: np.ndarray, when: float) -> tuple[np.ndarray, float]:
    """Powers of the times that make a parabola, or a line of few frames; and their unit [s]."""
    reach = float(np.ptp(times))
    return np.vander((times - when) / reach, 2 if len(times) < 4 else 3, increasing=True), reach
