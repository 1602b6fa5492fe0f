"""Error against certificate and margin, over the published clouds and the recordings: what is wrong must say so."""

import numpy as np
import pytest

from optshape_graph.calibration.mocap.comparison import leave_one_out
from optshape_graph.calibration.mocap.session import load_mocap_scans
from optshape_graph.io import load_session, load_target
from optshape_graph.pose import estimate_pose
from tests.pose.clouds import errors, reference_cases
from tests.shared import SHARED, needs_shared

pytestmark = pytest.mark.benchmark


@needs_shared
def test_table_of_errors_certificates_and_margins() -> None:
    rows = []
    for case in reference_cases():
        estimate = estimate_pose(case.scan, load_target("paper"))
        rows.append((case.name, estimate, errors(estimate, case.T_lidar_target)[1]))
    for k in (1, 3, 5):
        scans, left_out = load_mocap_scans(load_session(SHARED / f"data/mocap/session{k}/session.yaml"))
        assert left_out == ()
        rows += [(s.name, s.estimate, e.e_r_deg) for s, e in zip(scans, leave_one_out(scans), strict=True)]
    print(f"\n{'cloud':16s} {'e_r deg':>8s} {'status':>10s} {'certified':>9s} {'gap mm2':>9s} {'margin':>8s}")
    for name, estimate, e_r in rows:
        certificate = estimate.certificate
        print(
            f"{name:16s} {e_r:8.2f} {estimate.status:>10s} {certificate.certified!s:>9s} "
            f"{1e6 * certificate.gap_m2:9.1e} {estimate.ambiguity.margin:8.1f}"
        )
    assert len(rows) == 50
    assert max(estimate.certificate.gap_m2 for _, estimate, _ in rows) <= 1e-4**2
    wrong = [e for _, e, e_r in rows if e_r > 10 and e.certificate.certified and e.status == "ok"]
    assert not [estimate for estimate in wrong if estimate.ambiguity.margin > 10]
    assert np.mean([estimate.certificate.certified for _, estimate, _ in rows]) == 1.0
