"""Tasks on a Dask cluster, with TLS if asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from optshape_graph.errors import InputError, missing_extra
from optshape_graph.io.files import read_head
from optshape_graph.runs.tasks import Lost, OneThread

T = TypeVar("T")
R = TypeVar("R")

SCHEDULER_TIMEOUT_S = 10
"""How long to wait for a Dask scheduler to answer."""

AHEAD = 3
"""Tasks handed out for each thread of the cluster; more would only take memory."""


def on_cluster(
    function: Callable[[T], R], tasks: Iterable[tuple[int, T]], address: str, tls: tuple[Path, Path, Path] | None
) -> Iterator[tuple[int, R | Lost]]:
    """Apply a function to numbered tasks on a cluster, and yield number and result of each as it is finished.

    Args:
        function: importable by name.
        tasks: with their numbers; they are taken a few at a time.
        address: of the scheduler, as tcp://HOST:PORT or tls://HOST:PORT.
        tls: files with the authority's certificate, the own certificate and the own key; None: without TLS.

    Raises:
        InputError: no scheduler answers, or files for TLS that do not fit.
        MissingExtraError: Dask is absent.
    """
    try:
        from distributed import Client, KilledWorker, Security, as_completed
    except ImportError as cause:
        raise missing_extra("distributed", "dask", cause) from cause
    if tls is not None:
        _check_certificates(*tls)
    _check_reachable(address)
    security: dict[str, Any] = {}
    if tls is not None:
        authority, certificate, key = map(str, tls)
        security["security"] = Security(
            tls_ca_file=authority, tls_client_cert=certificate, tls_client_key=key, require_encryption=True
        )
    try:
        client = Client(address, timeout=SCHEDULER_TIMEOUT_S, **security)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"no Dask scheduler answers at {address} ({error})") from error
    with client:
        remaining, numbers = iter(tasks), dict[Any, int]()
        finished = as_completed(raise_errors=False)

        def submit() -> None:
            task = next(remaining, None)
            if task is not None:
                future = client.submit(OneThread(function), task[1], pure=False, retries=1)
                numbers[future.key] = task[0]
                finished.add(future)

        threads = sum(client.nthreads().values()) or 1
        for _ in range(AHEAD * threads):
            submit()
        for future in finished:
            number, failure = numbers.pop(future.key), future.exception()
            submit()
            if isinstance(failure, KilledWorker):
                yield number, Lost(f"its worker was killed ({failure})")
            elif failure is not None:
                raise failure
            else:
                yield number, future.result()


def _check_certificates(authority: Path, certificate: Path, key: Path) -> None:
    """Read the files for TLS, so that an error names the one that is wrong.

    Raises:
        InputError: not certificates and a key in PEM, the key of another certificate, or a key with a password.
    """
    import ssl

    for path in (authority, certificate, key):
        read_head(path, 1)  # missing, or not to be read
        if not path.is_file():
            raise InputError(f"{path}: expected a file")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(authority)
    except OSError as error:
        raise InputError(f"{authority}: expected the certificate of an authority, in PEM ({error})") from error
    try:
        context.load_cert_chain(certificate, key, password="")  # else it is asked for, on the terminal
    except OSError as error:
        raise InputError(
            f"{certificate}, {key}: expected a certificate and its own key without password, in PEM ({error})"
        ) from error


def _check_reachable(address: str) -> None:
    """Check that a scheduler listens at an address: Dask's client would wait for one, and try again and again.

    Raises:
        InputError: not an address, or nothing listens there.
    """
    import re
    import socket

    found = re.fullmatch(r"(?:(?:tcp|tls)://)?(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]{1,253}):([0-9]{1,5})", address)
    if found is None or int(found[2]) > 65535:
        raise InputError(
            f"expected the address of a scheduler, as tcp://HOST:PORT or tls://HOST:PORT; found '{address}'"
        )
    try:
        socket.create_connection((found[1].strip("[]"), int(found[2])), SCHEDULER_TIMEOUT_S).close()
    except (OSError, UnicodeError) as error:
        raise InputError(f"no Dask scheduler answers at {address} ({error})") from error
