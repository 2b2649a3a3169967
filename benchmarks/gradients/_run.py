"""Derivatives beside slopes, motion by motion; the table."""

import argparse
import sys
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dano
from benchmarks._measure import load_average, parse_arguments, report, Row
from benchmarks.gradients import _toss
from benchmarks.gradients._families import CONTACT, families, Family
from dano.gradients import check

STEP = 1e-2  # of what is one of a number
FLAT = 1e-3  # m: slopes below this are of numbers that do nothing


class Found(NamedTuple):
    """Of all numbers of all motions of a family, shape (motions · 10,).

    Attributes:
        derivatives: In reverse mode.
        forward: In forward mode.
        slopes: Over plus and minus a visible step.
        ripples: Of the function, by its range.
    """

    derivatives: np.ndarray
    forward: np.ndarray
    slopes: np.ndarray
    ripples: np.ndarray


def study(family: Family, count: int) -> Found:
    """Look at some motions of a family."""
    end = jax.jit(family.end)
    reverse, forward = jax.jit(jax.grad(family.end)), jax.jit(jax.jacfwd(family.end))
    labels = [*CONTACT, *family.labels]
    rows = []
    for seed in range(count):
        draw = family.random(np.random.default_rng(seed))
        at = jnp.asarray(draw.numbers), draw.state, jnp.asarray(draw.direction)
        slope = np.asarray(reverse(*at))
        found = check(
            lambda x, at=at: end(x, *at[1:]), at[0], steps=(STEP, STEP / 10), scale=draw.scales,
            labels=[labels[i] for i in range(len(labels))], directions=len(labels), gradient=slope,
        )  # fmt: skip
        ripples = [line.roughness / line.range if line.range > 0 else 0.0 for line in found.lines]
        slopes = [line.slopes[0] for line in found.lines]
        # In metres by what is one of each number.
        scales = draw.scales
        rows.append((slope * scales, np.asarray(forward(*at)) * scales, np.array(slopes) * scales, ripples))
    return Found(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))


def rows_of(group: str, found: Found) -> list[Row]:
    """What a table says of some motions."""
    moving = np.abs(found.slopes) > FLAT
    derivatives, slopes = found.derivatives[moving], found.slopes[moving]
    right = 100 * np.mean(np.sign(derivatives) == np.sign(slopes))
    apart = 100 * np.abs(derivatives - slopes) / np.abs(slopes)
    size = np.maximum(np.abs(found.derivatives), FLAT)
    modes = np.abs(found.forward - found.derivatives) / size
    note = f"quartiles {np.quantile(apart, 0.25):.2g}, {np.quantile(apart, 0.75):.2g}; {moving.sum()} numbers"
    return [
        Row(group, "derivatives with the sign of the slope", float(right), "%", 95.0, True),
        Row(group, "difference from the slope, median", float(np.median(apart)), "%", 10.0, note=note),
        Row(group, "ripple by range, median", 100 * float(np.median(found.ripples[moving])), "%", 1.0),
        Row(group, "forward less reverse, 99 % of numbers", float(np.quantile(modes, 0.99)), "", 1e-6),
    ]


def run() -> None:
    """Measure, print and report."""
    arguments = parse_arguments("Derivatives through impacts over a hundred motions.", _options)
    load, rows = load_average(), []
    if arguments.table == "toss":
        settings = {"dtype": "float64", "quick": arguments.quick}
        report("gradients-toss", _toss.rows(quick=arguments.quick), settings, load, arguments.json)
        return
    for name, law in (("default law", dano.DistributedLaw()), ("centroid law", dano.CentroidLaw())):
        every = []
        for kind, family in families(law).items():
            if arguments.only and kind not in arguments.only:
                continue
            began = time.monotonic()
            found = study(family, 2 if arguments.quick else family.motions)
            every.append(found)
            rows += rows_of(f"{name}: {kind}", found)
            print(f"{name}, {kind}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
            for row in rows[-4:]:
                print(f"    {row.name}: {row.value:.3g} {row.note}", file=sys.stderr, flush=True)
        together = Found(*(np.concatenate(parts) for parts in zip(*every, strict=True)))
        rows += rows_of(f"{name}: all {len(together.slopes) // 10} motions", together)
    report("gradients", rows, {"dtype": "float64", "quick": arguments.quick}, load, arguments.json)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--table", choices=("motions", "toss"), default="motions", help="what is measured")
    parser.add_argument("--only", nargs="+", help="some families")
