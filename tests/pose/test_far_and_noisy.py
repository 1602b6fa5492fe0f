"""Far away, with noisy angles: a flipped pose is flagged, and few are flipped."""

import numpy as np

from optshape_graph.evaluation.simulation import SimulationSweep, run_simulation
from optshape_graph.io import load_target


def test_a_flip_is_never_ok(tmp_path) -> None:
    """At noise level 3 (0.3 deg), 24 and 36 m, 4 to 9 rings: no flip is ok; most scans are, and are right."""
    sweep = SimulationSweep(load_target("paper"), None, ("global",), (24.0, 36.0), noise=("3",), draws=10, seed=3)
    rows = run_simulation(sweep, tmp_path)
    e_r = np.array([row["e_r_deg"] for row in rows], dtype=float)
    ok = np.array([row["status"] == "ok" for row in rows])
    assert not (ok & (e_r > 90)).any()
    assert ok.mean() > 0.6
    assert np.mean(e_r > 90) < 0.15
