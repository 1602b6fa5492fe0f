"""A Dask cluster over TLS: a scheduler and a worker of their own, certificates made here."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from optshape_graph import InputError
from optshape_graph.io import demo_folder
from optshape_graph.runs.workers import Pool

pytest.importorskip("distributed")
if shutil.which("openssl") is None:
    pytest.skip("openssl is needed to make certificates", allow_module_level=True)

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def make_certificates(folder: Path) -> list[Path]:
    """Make an authority, and a certificate that it signs: paths of its certificate, of that one, and of its key."""
    folder.mkdir()

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out", "ca.pem", "-days", "2",
            "-subj", "/CN=authority of a test")  # fmt: skip
    openssl("req", "-newkey", "rsa:2048", "-nodes", "-keyout", "key.pem", "-out", "request.pem", "-subj", "/CN=member")
    openssl("x509", "-req", "-in", "request.pem", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-out",
            "cert.pem", "-days", "2")  # fmt: skip
    return [folder / name for name in ("ca.pem", "cert.pem", "key.pem")]


@dataclass(frozen=True)
class Cluster:
    """Address of a scheduler that has a worker, and what is shown to it."""

    address: str
    files: list[Path]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    folder = tmp_path_factory.mktemp("tls")
    files = make_certificates(folder / "ours")
    tls = ["--tls-ca-file", str(files[0]), "--tls-cert", str(files[1]), "--tls-key", str(files[2])]
    contact = folder / "scheduler.json"
    started = []

    def start(program: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"distributed.cli.{program}", *arguments, *tls, "--no-dashboard"]
        with (folder / f"{program}.log").open("wb") as log:
            started.append(subprocess.Popen(command, env=ENVIRONMENT, cwd=folder, stdout=log, stderr=log))

    try:
        start("dask_scheduler", "--host", "tls://127.0.0.1", "--port", "0", "--scheduler-file", str(contact))
        address = ""
        deadline = time.monotonic() + 120
        while not address and time.monotonic() < deadline and started[0].poll() is None:
            time.sleep(0.1)
            address = json.loads(contact.read_text())["address"] if contact.exists() else ""
        assert address.startswith("tls://127.0.0.1:"), (folder / "dask_scheduler.log").read_text()
        start("dask_worker", address, "--nworkers", "1", "--nthreads", "1", "--no-nanny")
        yield Cluster(address, files)
    finally:
        for process in started:
            process.kill()
            process.wait()


def estimate(*options: object) -> subprocess.CompletedProcess[str]:
    demo = demo_folder()
    scans = [demo / "4m.pcd", demo / "8m.pcd"]
    command = ["estimate", *scans, "--target", demo / "target.yaml", "--sensor", demo / "sensor.yaml", *options]
    return subprocess.run(
        [sys.executable, "-m", "optshape_graph", *map(str, command)], env=ENVIRONMENT, capture_output=True, text=True,
        timeout=180,
    )  # fmt: skip


def test_results_are_those_of_this_process(cluster: Cluster, tmp_path: Path) -> None:
    there = estimate("--dask", cluster.address, "--dask-tls", *cluster.files, "--json", tmp_path / "there.json")
    assert there.returncode == 0, there.stderr
    assert estimate("--json", tmp_path / "here.json").returncode == 0
    assert (tmp_path / "there.json").read_bytes() == (tmp_path / "here.json").read_bytes()


def test_certificates_of_another_authority_are_refused(cluster: Cluster, tmp_path: Path) -> None:
    said = estimate("--dask", cluster.address, "--dask-tls", *make_certificates(tmp_path / "theirs"))
    assert said.returncode == 2, said.stderr
    [line] = said.stderr.splitlines()
    assert line.startswith(f"optshape: error: no Dask scheduler answers at {cluster.address} (")


@pytest.mark.parametrize("scheme", ["tls://", "tcp://"])
def test_without_certificates_nobody_answers(scheme: str, cluster: Cluster) -> None:
    said = estimate("--dask", cluster.address.replace("tls://", scheme))
    assert said.returncode == 2, said.stderr
    [line] = said.stderr.splitlines()
    assert line.startswith("optshape: error: ")
    assert "127.0.0.1" in line


def test_files_that_are_no_certificates_are_refused(cluster: Cluster, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.pem"
    wrong.write_text("a key\n")
    locked = tmp_path / "locked.pem"
    subprocess.run(["openssl", "rsa", "-aes256", "-passout", "pass:secret", "-in", cluster.files[2], "-out", locked],
                   check=True, capture_output=True)  # fmt: skip
    ca, certificate, key = cluster.files
    for files in ([wrong, certificate, key], [ca, wrong, key], [ca, certificate, wrong], [ca, ca, key],
                  [ca, certificate, locked]):  # fmt: skip
        with pytest.raises(InputError, match=r"\.pem: expected"):
            dict(Pool(dask=cluster.address, tls=tuple(files)).run(str, [(0, "a")]))
