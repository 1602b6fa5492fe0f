"""Landmark SLAM against the bare pose graph of Between factors, and against callbacks: ratios of times in one run."""

import resource
import time
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from optshape_graph.evaluation.metrics import pose_error
from optshape_graph.evaluation.trajectories import absolute_error, pose_nees, predicted_rmse
from optshape_graph.factors import TemplateCallbackFactor, TemplateMeasurement, summarise
from optshape_graph.graph.solve import CONVERGED
from optshape_graph.io import load_sensor
from optshape_graph.io.recordings import Recording
from optshape_graph.mapping import (
    Landmark,
    LandmarkSlam,
    Map,
    MappingProblem,
    Match,
    Odometry,
    Sighting,
    Start,
    Track,
    solve_batch,
)
from optshape_graph.mapping.incremental_graph import LOSS
from optshape_graph.mapping.recording import (
    KeyframePolicy,
    MotionNoise,
    OdometryTrack,
    Progress,
    build_map,
    keyframes,
    observe_all,
)
from optshape_graph.pose import estimate_pose
from optshape_graph.runs.workers import Pool
from optshape_graph.se3 import inverse
from optshape_graph.simulation import Box, ConstantTwist, NoiseModel, Patch, Scene, simulate
from tests.factors.support import TARGET, edge_points, measure, retract
from tests.io.recordings.writing import LAYOUTS, maker, write_bag
from tests.mapping.support import World, at, covariance, loop
from tests.mapping.test_motion import TARGET as PAPER
from tests.mapping.test_motion import placed, scanned, solve_one

SIGMA = 0.01
START = Start(np.eye(4), 1e-8 * np.eye(6))


def driven(n_poses: int) -> tuple[World, list[np.ndarray], list[list[int]]]:
    """Return five laps or fewer past 20 targets, the odometry, and the three nearest targets of each pose."""
    laps = max(1, n_poses // 200)
    world = loop(length=200.0, n_poses=n_poses // laps, n_targets=20, laps=laps, beside=8.0)
    return world, world.odometry(np.random.default_rng(0)), [world.near(i, np.inf, 3) for i in range(n_poses)]


def dead_reckoning(odometry: list[np.ndarray]) -> np.ndarray:
    poses = [np.eye(4)]
    for T in odometry:
        poses.append(poses[-1] @ T)
    return np.array(poses)


@cache
def problem_of(n_poses: int) -> MappingProblem:
    """Return the batch problem, poses initially where odometry has them, landmarks where they were first seen from."""
    rng = np.random.default_rng(1)
    world, odometry, near = driven(n_poses)
    poses = dead_reckoning(odometry)
    C = covariance(world.motion_sigma)
    matches, landmarks = [], {}
    for i, seen in enumerate(near):
        for j in seen:
            measurement = measure(rng, inverse(world.targets[j]) @ world.poses[i])
            matches.append(Match(i, f"t{j}", Sighting(TARGET, (measurement,), f"t{j}"), 0))
            landmarks.setdefault(f"t{j}", poses[i] @ inverse(measurement.T_target_lidar))
    edges = tuple(Odometry(i, i + 1, T, C) for i, T in enumerate(odometry))
    track = Track("robot", np.arange(n_poses, dtype=float), poses, edges, tuple(matches), START)
    return MappingProblem((track,), dict.fromkeys(landmarks, TARGET), landmarks)


def bare_graph(problem: MappingProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the same graph of Between factors, each between the poses that the measurement's own minimum gives.

    Its robust loss is the batch's, too.
    """
    graph, values = chain(problem)
    key = {name: L(k) for k, name in enumerate(problem.T_world_target)}
    matches, loss = problem.tracks[0].matches, gtsam.noiseModel.mEstimator.Huber.Create(LOSS)
    for match, summary in zip(matches, summarise([m.measurement for m in matches]), strict=True):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(summary.sqrt_information, False)
        pose = gtsam.Pose3(summary.T_target_lidar)
        robust = gtsam.noiseModel.Robust.Create(loss, noise)
        graph.push_back(gtsam.BetweenFactorPose3(key[match.landmark], X(match.pose), pose, robust))
    return graph, values


def as_far(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.LevenbergMarquardtOptimizer:
    """Return GTSAM's solver, ending where the batch does: its default leaves some units of half a chi-square."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(CONVERGED)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)


def callback_graph(problem: MappingProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the same graph with the exact factors as callbacks."""
    graph, values = chain(problem)
    key = {name: L(k) for k, name in enumerate(problem.T_world_target)}
    for match in problem.tracks[0].matches:
        graph.push_back(TemplateCallbackFactor(match.measurement, key[match.landmark], X(match.pose)))
    return graph, values


def chain(problem: MappingProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the odometry and the start, and all initial values."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    [track] = problem.tracks
    start = gtsam.noiseModel.Gaussian.Covariance(START.covariance)
    graph.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(START.T_world_lidar), start))
    for edge in track.odometry:
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        graph.push_back(gtsam.BetweenFactorPose3(X(edge.i), X(edge.j), gtsam.Pose3(edge.T_i_j), noise))
    for i, T in enumerate(track.T_world_lidar):
        values.insert(X(i), gtsam.Pose3(T))
    for k, T in enumerate(problem.T_world_target.values()):
        values.insert(L(k), gtsam.Pose3(T))
    return graph, values


def seconds(function, repeat: int = 3) -> float:
    """Return the least processor time of a few runs: both sides of a ratio run on one core."""
    times = []
    for _ in range(repeat):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def scans(n_poses: int, n_points: int = 40):
    """Return what a front end hands over: for each pose its odometry, and edge points with their edges and targets."""
    rng = np.random.default_rng(2)
    world, odometry, near = driven(n_poses)
    for i, seen in enumerate(near):
        points = []
        for j in seen:
            H = inverse(world.targets[j]) @ world.poses[i]
            points.append(
                (j, *edge_points(rng, inverse(H), n_points, noise=SIGMA), retract(H, 0.005 * rng.normal(size=6)))
            )
        yield i, (None if i == 0 else odometry[i - 1]), points


def template_measurement(points: np.ndarray, edge: np.ndarray, T: np.ndarray) -> TemplateMeasurement:
    return TemplateMeasurement.from_edge_points(points, TARGET.normals[edge], TARGET.offsets[edge], SIGMA, SIGMA, T)


@pytest.mark.benchmark
def test_incremental_against_the_bare_graph(capsys):
    n_poses = 1000
    world, _, _ = driven(n_poses)
    C = covariance(world.motion_sigma)
    odometry_noise = gtsam.noiseModel.Gaussian.Covariance(C)
    stream = list(scans(n_poses))
    measured = [[template_measurement(p, e, T) for _, p, e, T in points] for _, _, points in stream]
    summaries = [summarise(measurements) for measurements in measured]

    slam = LandmarkSlam(confirmations=1)
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.005)  # as LandmarkSlam has it
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    seen: set[int] = set()
    estimate = gtsam.Pose3()
    ours, bare = [], []
    # Both runs advance pose by pose, so that what else the machine does hits them alike.
    for i, motion, points in stream:
        begin = time.process_time()
        slam.add_odometry(float(i), motion, None if motion is None else C)
        sightings = [Sighting(TARGET, (template_measurement(p, e, T),), f"t{j}") for j, p, e, T in points]
        slam.add_measurements(sightings)
        _ = slam.pose
        ours.append(time.process_time() - begin)

        begin = time.process_time()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if motion is None:
            start = gtsam.noiseModel.Gaussian.Covariance(START.covariance)
            graph.push_back(gtsam.PriorFactorPose3(X(0), estimate, start))
        else:
            step = gtsam.Pose3(motion)
            estimate = estimate.compose(step)
            graph.push_back(gtsam.BetweenFactorPose3(X(i - 1), X(i), step, odometry_noise))
        values.insert(X(i), estimate)
        for (j, *_), summary in zip(points, summaries[i], strict=True):
            H = gtsam.Pose3(summary.T_target_lidar)
            noise = gtsam.noiseModel.Gaussian.SqrtInformation(summary.sqrt_information, False)
            graph.push_back(gtsam.BetweenFactorPose3(L(j), X(i), H, noise))
            if j not in seen:
                seen.add(j)
                values.insert(L(j), estimate.compose(H.inverse()))
        isam.update(graph, values)
        estimate = isam.calculateEstimatePose3(X(i))
        bare.append(time.process_time() - begin)
    ratio = np.mean(ours) / np.mean(bare)
    with capsys.disabled():
        print(
            f"\nincremental, {n_poses} poses x 3 of 20 targets: mean update {1e3 * np.mean(ours):.2f} ms, bare "
            f"{1e3 * np.mean(bare):.2f} ms, ratio {ratio:.2f}; medians {1e3 * np.median(ours):.2f}, "
            f"{1e3 * np.median(bare):.2f}; {dict(slam.counts)}"
        )
    assert ratio <= 1.5


@pytest.mark.benchmark
def test_batch_against_callbacks(capsys):
    problem = problem_of(1000)
    solution = solve_batch(problem)
    ours = seconds(lambda: solve_batch(problem))
    callbacks, values = callback_graph(problem)
    exact = seconds(lambda: gtsam.LevenbergMarquardtOptimizer(callbacks, values).optimize(), repeat=1)
    with capsys.disabled():
        print(f"\nbatch, 1000 poses x 3: {ours:.3f} s; callbacks {exact:.2f} s, {exact / ours:.1f} x ours")
    assert solution.converged
    assert exact >= 10.0 * ours


@pytest.mark.benchmark
def test_batch_cost_grows_with_the_poses_as_that_of_the_bare_graph(capsys):
    sizes = [500, 1000, 2000, 4000, 10000]
    ours, bare, default = [], [], []
    for size in sizes:
        problem = problem_of(size)
        graph, values = bare_graph(problem)
        bare.append(seconds(lambda graph=graph, values=values: as_far(graph, values).optimize()))
        default.append(
            seconds(lambda graph=graph, values=values: gtsam.LevenbergMarquardtOptimizer(graph, values).optimize())
        )
        ours.append(seconds(lambda problem=problem: solve_batch(problem)))
    exponent = np.polyfit(np.log(sizes), np.log(ours), 1)[0]
    ratios = np.divide(ours, bare)
    with capsys.disabled():
        listed = ", ".join(f"{n}: {t:.2f} s" for n, t in zip(sizes, ours, strict=True))
        print(
            f"\nbatch by poses: {listed}; exponent {exponent:.2f}; bare LM of the same cost, as far: ratios "
            f"{np.round(ratios, 2)}; as far as it goes by itself: {np.round(np.divide(ours, default), 2)}"
        )
    assert exponent <= 1.2
    assert ratios.max() <= 2.0


def driven_by_slam(seed: int, known: bool, wrong: float, n_poses: int = 250) -> dict[str, float]:
    """Drive a 500 m loop past 12 targets seen within 20 m; return errors, what marginals predict, and NEES per dof."""
    world = loop(n_poses=n_poses)
    rng, liar = np.random.default_rng(seed), np.random.default_rng(1000 + seed)
    survey = Map(
        tuple(
            Landmark(f"t{j}", TARGET, retract(T, 0.01 * np.random.default_rng([seed, j]).normal(size=6)), SURVEY)
            for j, T in enumerate(world.targets)
        )
    )
    start = Start(world.poses[0], 1e-8 * np.eye(6))
    slam = LandmarkSlam(survey if known else None, start)
    odometry = world.odometry(rng)
    for i in range(n_poses):
        slam.add_odometry(float(i), odometry[i - 1] if i else None, covariance(world.motion_sigma) if i else None)
        names = {j: int(liar.integers(12)) if liar.random() < wrong else j for j in world.near(i, 20.0)}
        slam.add_measurements([world.sighting(rng, i, j, f"t{k}") for j, k in names.items()])
    slam.settle()
    solution = solve_batch(slam.problem())
    numbers = list(range(5, n_poses, 10))
    estimated = solution.trajectory("session").poses
    C = np.array([solution.covariance(poses=[("session", i)]) for i in numbers])
    apart = estimated[numbers, :3, 3] - world.poses[numbers][:, :3, 3]
    return {
        "error": float(np.square(apart).sum(axis=1).mean()),
        "predicted": predicted_rmse(C) ** 2,
        "odometry": float(np.square(dead_reckoning(odometry)[:, :3, 3] - world.poses[:, :3, 3]).sum(axis=1).mean()),
        "incremental": float(np.square(slam.trajectory.poses[:, :3, 3] - world.poses[:, :3, 3]).sum(axis=1).mean()),
        "nees": float(pose_nees(estimated[numbers], world.poses[numbers], C).mean() / 6),
        "aligned": absolute_error(estimated, world.poses).translation.rmse ** 2,
    }


SURVEY = covariance([0.01] * 6)
SEEDS = 20


def over_seeds(known: bool, wrong: float) -> dict[str, float]:
    runs = [driven_by_slam(seed, known, wrong) for seed in range(SEEDS)]
    mean = {name: float(np.mean([run[name] for run in runs])) for name in runs[0]}
    return {name: value if name == "nees" else float(np.sqrt(value)) for name, value in mean.items()}


@pytest.mark.benchmark
@pytest.mark.parametrize("known", [False, True])
def test_loop_error_is_what_the_marginals_predict(known, capsys):
    honest, lied_to = over_seeds(known, 0.0), over_seeds(known, 0.1)
    with capsys.disabled():
        for name, result in (("all names right", honest), ("10 % wrong", lied_to)):
            print(
                f"\nloop of 500 m, {SEEDS} seeds, landmarks {'surveyed' if known else 'unknown'}, {name}: "
                f"RMSE {result['error']:.3f} m, predicted {result['predicted']:.3f}, NEES/dof {result['nees']:.2f}; "
                f"incremental {result['incremental']:.3f}, aligned {result['aligned']:.3f}, "
                f"odometry alone {result['odometry']:.2f}"
            )
        print(f"\n  10 % wrong against none: {lied_to['error'] / honest['error']:.2f}")
    assert honest["error"] <= 1.2 * honest["predicted"]
    assert 0.8 <= honest["nees"] <= 1.25
    assert lied_to["error"] <= 1.2 * honest["error"]


@pytest.mark.benchmark
def test_moving_against_standing_still(capsys):
    still, ignored, moving = [], [], []
    for seed in range(60):
        T = placed(seed)
        skewed = scanned(T, seed, moving=True)
        still.append(pose_error(PAPER, estimate_pose(scanned(T, seed, moving=False), PAPER).T_lidar_target, T).rmse)
        ignored.append(pose_error(PAPER, estimate_pose(skewed, PAPER).T_lidar_target, T).rmse)
        values, middle = solve_one(skewed, seed)
        moving.append(pose_error(PAPER, inverse(middle) @ values.atPose3(L(0)).matrix(), T).rmse)
    rms = [float(np.sqrt(np.mean(np.square(x)))) for x in (still, ignored, moving)]
    with capsys.disabled():
        print(
            f"\n2 m/s and 90 deg/s, 60 placements: vertex RMSE {1e3 * rms[2]:.1f} mm with the motion factor, "
            f"{1e3 * rms[0]:.1f} standing still, {1e3 * rms[1]:.0f} with the motion ignored"
        )
    assert rms[2] <= 1.2 * rms[0]


LAP = 200
"""Scans of a lap; later laps send the same ones again."""

N_SCANS = 1200
"""Two minutes at 10 Hz."""


def circling(T: float = 20.0, speed: float = 1.0) -> ConstantTwist:
    return ConstantTwist(at(0.0, -speed * T / (2 * np.pi), 0.0), np.array([0, 0, 2 * np.pi / T, speed, 0, 0.0]))


def write_drive(folder) -> Path:
    """Write two minutes of a robot that circles in a room with six targets on stands: VLP-32C scans and odometry."""
    sensor, motion = load_sensor("vlp32c"), circling()
    room = Box(np.array([18.0, 16.0, 4.0]), at(0.0, 0.0, 0.0, 0.8))
    angles = 2 * np.pi * np.arange(6) / 6
    patches = tuple(Patch(PAPER, at(6.0 * np.cos(a), 6.0 * np.sin(a), a, 0.2)) for a in angles)
    scene, noise = Scene(patches, (room,)), NoiseModel.of(sensor)
    bias = noise.draw_range_bias(sensor.n_rings, np.random.default_rng(0))

    def pose(stamp: float) -> np.ndarray:
        R, t = motion.at(np.array([stamp]))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R[0], t[0]
        return T

    def cloud(k: int) -> np.ndarray:
        moving = ConstantTwist(pose(0.1 * k), motion.twist)
        scan = simulate(scene, sensor, moving, noise=noise, rng=k, range_bias=bias).scan
        made = np.zeros(len(scan), LAYOUTS["velodyne"])
        made["x"], made["y"], made["z"] = scan.points.T
        made["ring"], made["time"], made["intensity"] = scan.ring, scan.time, scan.intensity
        return made

    make, clouds = maker("mcap"), [cloud(k) for k in range(LAP)]
    stamps = 1.7e9 + 0.1 * np.arange(N_SCANS)

    def messages():
        yield "/odom", make.odometry(stamps[0] - 0.1, pose(-0.1))
        for k, stamp in enumerate(stamps):
            yield "/points", make.cloud(stamp, clouds[k % LAP])
            for part in range(5):
                yield "/odom", make.odometry(stamp + 0.02 * part, pose(0.1 * k + 0.02 * part))
        yield "/odom", make.odometry(stamps[-1] + 0.1, pose(0.1 * N_SCANS))

    return write_bag(folder, "mcap", messages())


@pytest.fixture(scope="module")
def drive_bag(tmp_path_factory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drive"))


@pytest.mark.benchmark
@pytest.mark.parametrize("every", [False, True])
def test_two_minutes_of_driving(drive_bag, every, capsys):
    """Keyframes as `optshape map` takes them, solved as a batch at the end; or every scan, with a lag."""
    slam, progress = LandmarkSlam(lag=10.0 if every else None), Progress()
    policy = KeyframePolicy(0.0) if every else KeyframePolicy()
    held = []

    def note(now: Progress) -> None:
        if now.keyframes % 20 == 0:
            held.append(resident())

    begin, processor = time.perf_counter(), used()
    recording = Recording(drive_bag)
    stream = recording.scans(sensor=load_sensor("vlp32c"))
    frames = keyframes(stream, OdometryTrack(recording.poses()), policy, progress)
    build_map(
        slam, observe_all(frames, [PAPER], False, False, Pool(2), biases=not every), MotionNoise(), progress, note
    )
    slam.settle()
    if not every:
        solve_batch(slam.problem())
    took, processor = time.perf_counter() - begin, used() - processor
    quarter = max(held[: len(held) // 4])
    with capsys.disabled():
        print(
            f"\n{N_SCANS} full scans, {'every one' if every else 'keyframes'} ({progress.keyframes}) detected, "
            f"2 processes: {took:.0f} s, {0.1 * N_SCANS / took:.1f} x real time; processor time {processor:.0f} s, "
            f"{0.2 * N_SCANS / processor:.1f} x that of two cores; {len(slam.landmarks)} landmarks, "
            f"{progress.sightings} sightings, {dict(slam.counts)}; skipped {dict(progress.skipped)}; memory at most "
            f"{quarter:.0f} MB in the first quarter, {max(held):.0f} in all"
        )
    assert took < 0.1 * N_SCANS
    assert max(held) < 1.1 * quarter


def resident() -> float:
    """Return the memory, MB, that this process holds now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def used() -> float:
    """Return the processor time, seconds, of this process and of those that it has waited for."""
    both = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return sum(usage.ru_utime + usage.ru_stime for usage in both)
