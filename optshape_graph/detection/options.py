"""Settings of detection, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from optshape_graph.detection.results import Evidence
from optshape_graph.pose import PoseOptions


@dataclass(frozen=True)
class DetectionOptions:
    """Settings of `detect_targets`. The defaults suit spinning LiDARs of 16 to 128 rings.

    Each attribute states its unit, how its default was chosen, and the test in tests/detection that notices when it is
    wrong. test_options.py moves every one of them to where it is.

    Attributes:
        longest_gap: azimuth steps. Two returns of a ring that are further apart are cut apart. Rings on real targets
            have gaps of up to four steps. Test: test_segments.py, lost returns.
        steepest: rad. Surfaces seen at a larger angle of incidence are not taken for targets. Beyond 75 degrees a
            square metre spans fewer than four rings of most sensors. Test: test_segments.py, slanted wall.
        jump_sigmas: standard deviations of a range. A range that departs further from the straight line through its
            neighbours starts another surface. Four cuts 1 in 16,000 returns of one surface by mistake.
            Test: test_segments.py, jump and slanted wall.
        fewest_returns: a run of fewer returns has no direction. Three are the fewest with a residual.
            Test: test_segments.py, ends of a panel.
        rings_apart: rings. Runs of one surface are linked up to this many rings apart. A ring on a real target may
            have no return at all, so two. Test: test_options.py.
        tilt_window: rad. Runs near each other vote for one plane if the tilts that they stand for agree this well.
            Test: test_options.py.
        patch_sigmas: standard deviations of a return about its plane. A run whose root mean square distance is larger
            is not of that plane. Test: test_options.py.
        band_sigmas: standard deviations of a return about its plane. A return further off the plane is not the
            target's. 2.5 keep 98.8 %. Test: test_options.py.
        warp: metres, standard deviation. How far the surface of a target departs from the plane through its returns:
            boards bend. Test: test_options.py.
        fewest_rings: rings on a target. The ends of three rings say little more than its size.
            Test: test_options.py.
        size_seen: share of a target's area, and of its spread, that must be covered in full view.
            Test: test_options.py.
        size_seen_hidden: the same if something stands before the target. Test: test_options.py.
        size_seen_cut: the same if the target reaches the lowest or highest ring. The nearest recorded boards do.
            Test: test_options.py.
        size_excess: share by which a target may seem too large. Half a step at both ends of each ring, mixed returns
            and a part of a stand add up to no more. Test: test_options.py.
        thickest_limb: metres. Arms and poles are up to this wide. Test: test_candidates.py, an arm.
        limb_slack: azimuth steps by which a line through two ring ends may miss a third.
            Test: test_candidates.py, a convex outline has no limbs.
        least_evidence: a surface is not a target below these shares. Stands and arms touch targets, hands hide them,
            returns get lost. Test: test_options.py.
        sure_evidence: a target is not "ok" below these shares. The recorded boards, including those held in hands,
            stay above by at least 0.03. Test: test_options.py.
        rim: width of the strip beside the target that is looked at, as a share of the distance from its origin to its
            outline. Test: test_options.py.
        side_strip: width, metres, of the strip beyond each side, outside the range of the noise, in which the next face
            of a box is looked for; it has at least six rays. Test: test_options.py.
        hung_before: metres to the nearest wall that a target may hang before. Test: test_options.py.
        grazing: rad. The floor before a box is seen at up to this angle of incidence: 15 m away, from 1.3 m.
            Test: test_options.py.
        pierced_rays: a ring does not meet the target if at least so many of its rays pass through the target's place,
            Test: test_options.py.
        pierced_share: and if they are at least so many times its returns there. Test: test_detect.py, pole in the
            plane.
        rounds: the returns are chosen again, by the outline laid over them, at most this often. For the recorded
            boards they stay the same after two rounds. Test: test_options.py.
        first_look: a target is rejected before its pose is estimated if a smaller share of the ring ends lies on its
            outline. Right targets reach 0.87 or more. Test: test_options.py.
        first_look_odds: a target is rejected before its pose is estimated if its outline fits worse than another's by
            more than these log odds: twice the margin below which two poses count as equally likely.
            Test: test_options.py.
        pose: settings of the pose estimator, which judges each candidate.
    """

    longest_gap: float = 4.5
    steepest: float = float(np.radians(75.0))
    jump_sigmas: float = 4.0
    fewest_returns: int = 3
    rings_apart: int = 2
    tilt_window: float = float(np.radians(20.0))
    patch_sigmas: float = 3.0
    band_sigmas: float = 2.5
    warp: float = 0.005
    fewest_rings: int = 4
    size_seen: float = 0.8
    size_seen_hidden: float = 0.6
    size_seen_cut: float = 0.3
    size_excess: float = 0.2
    thickest_limb: float = 0.12
    limb_slack: float = 3.0
    least_evidence: Evidence = field(
        default=Evidence(
            contained=0.8, bounded=0.75, covered=0.6, edged=0.75, solid=0.9, free=0.75, stepped=0.75, apart=0.5,
            seen=0.4, distinct=1e-4,
        )
    )  # fmt: skip
    sure_evidence: Evidence = field(
        default=Evidence(
            contained=0.9, bounded=0.97, covered=0.75, edged=0.85, solid=0.9, free=0.8, stepped=0.85, apart=0.8,
            seen=0.7, distinct=0.999,
        )
    )  # fmt: skip
    rim: float = 0.4
    side_strip: float = 0.05
    hung_before: float = 0.2
    grazing: float = float(np.radians(85.0))
    pierced_rays: int = 6
    pierced_share: float = 3.0
    rounds: int = 3
    first_look: float = 0.6
    first_look_odds: float = 10.0
    pose: PoseOptions = field(default_factory=PoseOptions)
