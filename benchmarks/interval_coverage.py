"""Coverage of intervals over clusters in simulations, by clusters, fraction and correlation.

Run it as ``python benchmarks/interval_coverage.py [--trials 2000]``; it takes about a minute.
Clusters have 5 to 59 rows. Rows of a cluster have the correlation that is stated.
"""

from __future__ import annotations

import argparse

import numpy as np

from crosscue.eval.scoring.intervals import fraction_by_cluster, mean_by_cluster

CLUSTERS = (4, 5, 6, 8, 12, 20, 30, 60)
FRACTIONS = (0.5, 0.8, 0.95)
CORRELATIONS = (0.05, 0.2, 0.4, 0.6, 0.8)


def of_fraction(clusters: int, fraction: float, correlation: float, trials: int) -> float:
    """Return the coverage of the interval of a fraction."""
    rng = np.random.default_rng(clusters)
    rest = 1.0 / correlation - 1.0
    covered = 0
    for _ in range(trials):
        which = np.repeat(np.arange(clusters), rng.integers(5, 60, clusters))
        rates = rng.beta(fraction * rest, (1.0 - fraction) * rest, clusters)
        low, high = fraction_by_cluster(rng.random(len(which)) < rates[which], which)
        covered += low <= fraction <= high
    return covered / trials


def of_mean(clusters: int, correlation: float, trials: int) -> float:
    """Return the coverage of the interval of a mean."""
    rng = np.random.default_rng(clusters)
    between, within = np.sqrt([correlation, 1.0 - correlation]).tolist()
    covered = 0
    for _ in range(trials):
        which = np.repeat(np.arange(clusters), rng.integers(5, 60, clusters))
        values = rng.normal(0.0, between, clusters)[which] + rng.normal(0.0, within, len(which))
        low, high = mean_by_cluster(values, which)
        covered += low <= 0.0 <= high
    return covered / trials


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=2000)
    trials = parser.parse_args().trials
    print(f"per cent covered, nominally 95, {trials} trials")
    print(f"{'clusters':24}" + "".join(f"{clusters:7}" for clusters in CLUSTERS))
    for correlation in CORRELATIONS:
        for fraction in FRACTIONS:
            found = [100.0 * of_fraction(n, fraction, correlation, trials) for n in CLUSTERS]
            name = f"fraction {fraction:g}, corr. {correlation:g}"
            print(f"{name:24}" + "".join(f"{one:7.1f}" for one in found), flush=True)
        found = [100.0 * of_mean(n, correlation, trials) for n in CLUSTERS]
        print(f"{f'mean, corr. {correlation:g}':24}" + "".join(f"{one:7.1f}" for one in found))


if __name__ == "__main__":
    main()
