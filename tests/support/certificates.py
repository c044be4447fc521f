"""Certificates for tests of TLS, from an authority of their own, made once per run."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

HOST = "127.0.0.1"
"""The default host of `pems`."""


class Pems(NamedTuple):
    """Paths of PEM files."""

    ca: str
    """The authority's certificate."""
    cert: str
    """A certificate with its key, for a server or a client."""


@cache
def pems(host: str = HOST) -> Pems:
    """Make files of an authority, and of a certificate that it has issued to `host`.

    Each host has an authority of its own.
    """
    import trustme  # of 25 MB, which processes whose memory is measured would have without TLS

    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    authority = trustme.CA()
    found = Pems(str(folder / "ca.pem"), str(folder / "cert.pem"))
    authority.cert_pem.write_to_path(found.ca)
    authority.issue_cert(host).private_key_and_cert_chain_pem.write_to_path(found.cert)
    return found
