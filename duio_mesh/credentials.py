"""The certificates and passwords of one run: one folder per process, readable by its owner only, gone with the run.

Every run has an authority of its own, whose key never leaves the launcher's memory: a certificate of another run, or
one that was left behind by a launcher that was killed, opens nothing.
"""

from __future__ import annotations

import ipaddress
import os
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from duio_mesh.spec import AUTHORITY, CERTIFICATE, KEY, PASSWORD, USERS

if TYPE_CHECKING:  # imported where it is used: an open run does not pay for it
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
    from cryptography.x509 import Certificate, GeneralName, Name

LIFETIME = timedelta(days=30)  # in which a process may connect; a link that is up stays up
SKEW = timedelta(hours=1)  # by which the clocks of hosts may differ
BYTES = 32  # of a password, drawn at random


Hosts: TypeAlias = str | Mapping[str, tuple[str, ...]]  # the address of all, or the addresses and names of each


def issue(root: Path, mode: str, run: str, dials: Mapping[str, tuple[str, ...]], host: Hosts) -> dict[str, Path]:
    """Write what every process needs to prove who it is; the folder of each.

    ``root`` is made; ``dials`` says for every process to which others it connects; ``host`` is what they are dialled
    by: one address or name for all, or those of each. Raises OSError when a file cannot be written, ValueError when the
    mode is neither password nor mtls.
    """
    if mode not in ("password", "mtls"):
        raise ValueError(f"no such security mode: {mode}")
    root.mkdir(mode=0o700)
    folders = {who: root / who for who in dials}
    for folder in folders.values():
        folder.mkdir(mode=0o700)
    if mode == "mtls":
        _certificates(folders, run, dict.fromkeys(folders, (host,)) if isinstance(host, str) else host)
    else:
        _passwords(folders, dials)
    return folders


def remove(root: Path) -> None:
    """Remove all credentials of a run, if there are any."""
    if root.exists():
        shutil.rmtree(root)


def _write(path: Path, data: bytes) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as f:
        f.write(data)


def _passwords(folders: Mapping[str, Path], dials: Mapping[str, tuple[str, ...]]) -> None:
    """Each process' own password, and the list of those that may connect to it."""
    own = {who: secrets.token_hex(BYTES) for who in folders}
    for who, folder in folders.items():
        _write(folder / PASSWORD, own[who].encode())
        callers = [other for other, dialled in dials.items() if who in dialled]
        _write(folder / USERS, "".join(f"{other}:{own[other]}\n" for other in callers).encode())  # empty: nobody may


@dataclass(frozen=True)
class _Signer:
    """The run's authority."""

    key: EllipticCurvePrivateKey
    name: Name

    def certify(self, subject: Name, key: EllipticCurvePrivateKey, hosts: tuple[str, ...]) -> Certificate:
        """A certificate for ``subject``; without hosts that of an authority."""
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes
        from cryptography.x509.oid import ExtendedKeyUsageOID

        now = datetime.now(UTC)
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self.name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - SKEW)
            .not_valid_after(now + LIFETIME)
            .add_extension(x509.BasicConstraints(ca=not hosts, path_length=None if hosts else 0), True)
        )
        if hosts:
            both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
            builder = builder.add_extension(x509.ExtendedKeyUsage(both), False)
            builder = builder.add_extension(x509.SubjectAlternativeName([*map(_general_name, hosts)]), False)
        return builder.sign(self.key, hashes.SHA256())


def _general_name(host: str) -> GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _certificates(folders: Mapping[str, Path], run: str, hosts: Mapping[str, tuple[str, ...]]) -> None:
    """An authority, and for each process a key and a certificate that names the process and the run."""
    from cryptography import x509
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    def name(who: str) -> Name:
        return x509.Name(
            [
                x509.NameAttribute(NameOID.ORGANIZATION_NAME, f"duio_mesh run {run}"),
                x509.NameAttribute(NameOID.COMMON_NAME, who),
            ]
        )

    def pem(certificate: Certificate) -> bytes:
        return certificate.public_bytes(serialization.Encoding.PEM)

    signer = _Signer(ec.generate_private_key(ec.SECP256R1()), name("authority"))
    authority = pem(signer.certify(signer.name, signer.key, ()))
    for who, folder in folders.items():
        key = ec.generate_private_key(ec.SECP256R1())
        _write(folder / AUTHORITY, authority)
        _write(folder / CERTIFICATE, pem(signer.certify(name(who), key, hosts[who])))
        plain = serialization.NoEncryption()
        form = serialization.PrivateFormat.PKCS8
        _write(folder / KEY, key.private_bytes(serialization.Encoding.PEM, form, plain))
