"""Error against certificate and margin, over the published clouds and the recordings: what is wrong must say so."""

from contextlib import suppress
from time import process_time

import numpy as np
import pytest

from optshape_graph.calibration.mocap.comparison import leave_one_out
from optshape_graph.calibration.mocap.session import load_mocap_scans
from optshape_graph.errors import EstimationError
from optshape_graph.io import load_session, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.pose.certificate import certificates
from optshape_graph.pose.certificate.multipliers import closed_form_bounds
from optshape_graph.pose.certificate.relaxation import lower_bound
from tests.pose.clouds import errors, reference_cases, simulated
from tests.shared import SHARED, needs_shared

pytestmark = pytest.mark.benchmark


@needs_shared
def test_table_of_errors_certificates_and_margins() -> None:
    rows = []
    for case in reference_cases():
        estimate = estimate_pose(case.scan, load_target("paper"))
        rows.append((case.name, estimate, errors(estimate, case.T_lidar_target)[1]))
    for k in (1, 3, 5):
        scans, left_out, _ = load_mocap_scans(load_session(SHARED / f"data/mocap/session{k}/session.yaml"))
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


def test_closed_form_against_the_solver(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Certificates of 500 simulated scans: how many need no solver, and what they cost against one that does."""
    asked: list[tuple[np.ndarray, np.ndarray]] = []  # the forms that are certified, and the rotations

    def noting(forms: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked.extend(zip(forms, rotations, strict=True))
        return closed_form_bounds(forms, rotations)

    monkeypatch.setattr(certificates, "closed_form_bounds", noting)
    rng, count = np.random.default_rng(16), 0
    sensors = ("vlp16", "vlp32c", "os0-64", "os1-64", "os1-128", "hdl64e", "pandar64", "rs32")
    shapes = (
        "paper",
        "built",
        "optimal",
        "optimal3",
        "optimal5",
        "square",
        "diamond",
        "triangle",
        "circle",
        "paper@0.5",
    )
    while len(asked) < 500:
        sensor, shape = sensors[count % 8], shapes[count // 8 % 10]
        count += 1
        scan, _ = simulated(
            float(np.exp(rng.uniform(np.log(2.0), np.log(30.0)))), tuple(rng.uniform(-40, 40, 3)),
            seed=int(rng.integers(2**31)), target=shape, sensor=sensor,
        )  # fmt: skip
        with suppress(EstimationError):
            estimate_pose(scan, load_target(shape))
    forms, rotations = (np.array(some) for some in zip(*asked, strict=True))
    start = process_time()
    bounds, second = closed_form_bounds(forms, rotations)
    batched = process_time() - start
    start = process_time()
    for form, R in zip(forms, rotations, strict=True):
        closed_form_bounds(form[None], R[None])
    single = process_time() - start
    Q = np.zeros((500, 13, 13))  # the translation is eliminated already
    rotation_and_one = [*range(9), 12]
    Q[np.ix_(range(500), rotation_and_one, rotation_and_one)] = forms
    start = process_time()
    solved = np.array([lower_bound(q).bound for q in Q])
    solver = process_time() - start
    x = np.column_stack([np.swapaxes(rotations, 1, 2).reshape(-1, 9), np.ones(500)])
    costs, scale = np.einsum("bi,bij,bj->b", x, forms, x), np.trace(forms, axis1=1, axis2=2)
    tight = (costs - bounds <= 1e-8 * scale) & (second > 0)
    with capsys.disabled():
        print(
            f"\nclosed form: {tight.mean():.1%} of 500 need no solver (asked: 93 %); the solver takes "
            f"{solver / single:.1f} times as long (asked: 8), "
            f"{solver / batched:.0f} times where 500 are done at once (asked: 60)"
        )
    assert tight.mean() >= 0.93
    assert solver / single >= 8
    assert solver / batched >= 60
    assert not (tight & (costs - solved > 1e-6 * scale)).any()  # no verdict that the solver contradicts
