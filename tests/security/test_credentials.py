"""The files that prove who somebody is: what is in them, who can read them, and that another run's prove nothing."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from duio_mesh import credentials
from duio_mesh.spec import AUTHORITY, CERTIFICATE, KEY, PASSWORD, USERS

DIALS = {"plant": (), "node-1": ("plant",), "node-2": ("plant", "node-1"), "recorder": ("plant", "node-1", "node-2")}


def certificate(folder: Path, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / name).read_bytes())


@pytest.mark.parametrize("mode", ["mtls", "password"])
def test_only_the_owner_can_read_them(mode: str, tmp_path: Path) -> None:
    folders = credentials.issue(tmp_path / "keys", mode, "r", DIALS, "127.0.0.1")
    assert folders == {who: tmp_path / "keys" / who for who in DIALS}
    for path in [tmp_path / "keys", *(tmp_path / "keys").rglob("*")]:
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path
    names = {AUTHORITY, CERTIFICATE, KEY} if mode == "mtls" else {PASSWORD, USERS}
    assert all({p.name for p in folder.iterdir()} == names for folder in folders.values())
    credentials.remove(tmp_path / "keys")
    credentials.remove(tmp_path / "keys")
    assert not (tmp_path / "keys").exists()


def test_a_certificate_names_process_run_and_host(tmp_path: Path) -> None:
    folders = credentials.issue(tmp_path / "keys", "mtls", "cafe", DIALS, "127.0.0.1")
    for who, folder in folders.items():
        found, authority = certificate(folder, CERTIFICATE), certificate(folder, AUTHORITY)
        found.verify_directly_issued_by(authority)
        assert [a.value for a in found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] == [who]
        assert "cafe" in found.subject.rfc4514_string()
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert [str(ip) for ip in names.get_values_for_type(x509.IPAddress)] == ["127.0.0.1"]
        assert not found.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        key = serialization.load_pem_private_key((folder / KEY).read_bytes(), None)
        assert isinstance(key, ec.EllipticCurvePrivateKey)
        assert key.public_key() == found.public_key()
        assert key.public_key() != authority.public_key()
    assert len({(f / AUTHORITY).read_bytes() for f in folders.values()}) == 1
    assert len({(f / KEY).read_bytes() for f in folders.values()}) == len(folders)


def test_a_host_may_have_a_name(tmp_path: Path) -> None:
    folders = credentials.issue(tmp_path / "keys", "mtls", "r", DIALS, "tower.example")
    names = certificate(folders["plant"], CERTIFICATE).extensions.get_extension_for_class(x509.SubjectAlternativeName)
    assert names.value.get_values_for_type(x509.DNSName) == ["tower.example"]


def test_another_runs_authority_did_not_sign_it(tmp_path: Path) -> None:
    one = credentials.issue(tmp_path / "one", "mtls", "r", DIALS, "127.0.0.1")
    two = credentials.issue(tmp_path / "two", "mtls", "r", DIALS, "127.0.0.1")
    with pytest.raises(InvalidSignature):
        certificate(one["plant"], CERTIFICATE).verify_directly_issued_by(certificate(two["plant"], AUTHORITY))


def test_a_process_knows_the_passwords_of_those_that_call_it_only(tmp_path: Path) -> None:
    folders = credentials.issue(tmp_path / "keys", "password", "r", DIALS, "127.0.0.1")
    own = {who: (folder / PASSWORD).read_text() for who, folder in folders.items()}
    assert len({*own.values()}) == len(own)
    assert min(map(len, own.values())) >= 32
    for who, folder in folders.items():
        lines = dict(line.split(":") for line in (folder / USERS).read_text().splitlines())
        callers = {other for other, dialled in DIALS.items() if who in dialled}
        assert lines == {other: own[other] for other in callers}


def test_no_other_mode(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such security mode: open"):
        credentials.issue(tmp_path / "keys", "open", "r", DIALS, "127.0.0.1")
    assert not (tmp_path / "keys").exists()
