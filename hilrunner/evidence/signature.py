"""A signature beside a log: RUN.mcap.sig says whose key vouches for these bytes, so that a log is evidence between companies.

The checksums inside a log show that it was not damaged by chance; whoever can write a log can write checksums as well. A signature by
ed25519 (RFC 8032, of the package `cryptography`, extra `sign`) covers the SHA-256 and the length of the whole file. It stands in a file of its
own, so that the log stays what it was and any program can read it.
"""

import base64
import binascii
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from hilrunner.base import exit_codes
from hilrunner.base.errors import LogError, UsageError
from hilrunner.evidence.verdict import Judgement, said

ENDING = ".sig"
_FORMAT = "hilrunner log signature 1"
_LARGEST_FILE_BYTES = 65_536  # of keys and signatures: what is longer is neither
_KEY_BYTES, _SIGNATURE_BYTES = 32, 64
_MADE_BY = "openssl genpkey -algorithm ed25519 -out key.pem; openssl pkey -in key.pem -pubout -out public.pem"


@dataclass(frozen=True)
class Signature:
    """What a signature file says."""

    sha256: str
    size_bytes: int
    public_key: bytes
    signature: bytes

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the public key, as OpenSSH shortens it: told to people, compared by them."""
        return "SHA256:" + base64.b64encode(hashlib.sha256(self.public_key).digest()).decode().rstrip("=")


def signature_path(log: Path) -> Path:
    """Where the signature of a log stands."""
    return log.with_name(log.name + ENDING)


def load_private_key(path: Path):
    """An ed25519 private key from PEM or OpenSSH text. Raises UsageError."""
    serialization, ed25519 = _library()
    data = _small_file(path, "--key")
    loaders = (serialization.load_pem_private_key, serialization.load_ssh_private_key)
    return _loaded(
        path, data, [lambda d, load=load: load(d, password=None) for load in loaders], ed25519.Ed25519PrivateKey
    )


def load_public_key(path: Path) -> bytes:
    """The 32 bytes of an ed25519 public key from PEM or OpenSSH text. Raises UsageError."""
    serialization, ed25519 = _library()
    data = _small_file(path, "--signed-by")
    loaders = [serialization.load_pem_public_key, serialization.load_ssh_public_key]
    return _loaded(path, data, loaders, ed25519.Ed25519PublicKey).public_bytes_raw()


def sign(log: Path, key) -> str:
    """The text of the signature file of a log; `key` is of `load_private_key`. Raises LogError when the log cannot be read."""
    digest, size_bytes = _digest(log)
    signed = Signature(digest, size_bytes, key.public_key().public_bytes_raw(), key.sign(_message(digest, size_bytes)))
    table = {
        "format": _FORMAT,
        "algorithm": "ed25519",
        "sha256": signed.sha256,
        "size_bytes": signed.size_bytes,
        "public_key": base64.b64encode(signed.public_key).decode(),
        "fingerprint": signed.fingerprint,
        "signature": base64.b64encode(signed.signature).decode(),
    }
    return json.dumps(table, indent=1) + "\n"


def read_signature(log: Path) -> Signature | None:
    """The signature beside a log, not verified yet; None where there is none. Raises LogError when it cannot be read as one."""
    path = signature_path(log)
    if not path.exists():
        return None
    try:
        data = _small_file(path, str(path))
        table = json.loads(data)
        known = (table["format"], table["algorithm"]) == (_FORMAT, "ed25519")
        key, signature = (base64.b64decode(table[name], validate=True) for name in ("public_key", "signature"))
        found = Signature(str(table["sha256"]), int(table["size_bytes"]), key, signature)
    except (KeyError, TypeError, ValueError, RecursionError, binascii.Error, UsageError) as error:
        raise LogError(
            str(path), f"is no signature of a log: {error}", remedy="take it again from who signed"
        ) from None
    if not known or (len(key), len(signature)) != (_KEY_BYTES, _SIGNATURE_BYTES):
        raise LogError(str(path), "is a signature of another kind", f"{_FORMAT}, ed25519", "sign with this version")
    return found


def problem_of(log: Path, found: Signature) -> str:
    """Why a signature does not vouch for the log beside it; empty: it does. Raises UsageError without the extra `sign`."""
    from_bytes = _library()[1].Ed25519PublicKey.from_public_bytes
    from cryptography.exceptions import InvalidSignature

    digest, size_bytes = _digest(log)
    try:
        from_bytes(found.public_key).verify(found.signature, _message(found.sha256, found.size_bytes))
    except (InvalidSignature, ValueError):
        return "the signature does not fit its own key and hash"
    if (digest, size_bytes) != (found.sha256, found.size_bytes):
        return f"the log has changed since it was signed: SHA-256 {digest[:16]}… and not {found.sha256[:16]}…"
    return ""


def signature_judgements(log: Path, signed_by: Path | None) -> list[Judgement]:
    """What the signature beside a log says of it; nothing where there is none and none is asked for.

    Args:
        signed_by: file of the public key that must have signed it; None: any key, or none.

    Raises LogError for a signature that cannot be read, UsageError for a key that cannot, or without the extra `sign` where it is asked for.
    """
    found, wanted = read_signature(log), None if signed_by is None else load_public_key(signed_by)
    if found is None:
        detail = f"there is no {signature_path(log).name}"
        return [] if wanted is None else [said("signed_by", f"signed by the key {signed_by}", False, detail)]
    if wanted is None and not can_verify():
        return []
    problem = problem_of(log, found)
    detail = problem or f"key {found.fingerprint}; whose key that is, --signed-by tells"
    if wanted is not None and not problem:
        detail = f"key {found.fingerprint}"
    judged = [said("signature", "the log is the one that was signed", not problem, detail, exit_codes.DAMAGED)]
    if wanted is not None:
        judged.append(
            said(
                "signed_by",
                f"signed by the key {signed_by}",
                found.public_key == wanted,
                f"signed by {found.fingerprint}",
            )
        )
    return judged


def can_verify() -> bool:
    """Whether the extra `sign` is installed."""
    try:
        _library()
    except UsageError:
        return False
    return True


def _message(digest: str, size_bytes: int) -> bytes:
    return f"{_FORMAT}\n{digest}\n{size_bytes}\n".encode()


def _digest(log: Path) -> tuple[str, int]:
    try:
        with open(log, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            return digest, file.tell()
    except OSError as error:
        raise LogError(str(log), f"cannot be read: {error.strerror or error}", remedy="name a log") from None


def _library():
    try:
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError:
        problem = "the package 'cryptography' is not installed"
        raise UsageError("signature", problem, remedy="pip install 'hilrunner[sign]'") from None
    return serialization, ed25519


def _small_file(path: Path, place: str) -> bytes:
    try:
        if not path.is_file():
            raise UsageError(f"{place} {path}", "no such file", remedy=_MADE_BY)
        with open(path, "rb") as file:
            data = file.read(_LARGEST_FILE_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{place} {path}", f"cannot be read: {error.strerror or error}") from None
    if len(data) > _LARGEST_FILE_BYTES:
        raise UsageError(f"{place} {path}", "is too long for a key", f"{_LARGEST_FILE_BYTES} bytes", _MADE_BY)
    return data


def _loaded(path: Path, data: bytes, loaders: list, kind: type):
    from cryptography.exceptions import UnsupportedAlgorithm

    problem = "not a key in PEM or OpenSSH text"
    for load in loaders:
        try:
            key = load(data)
        except TypeError:  # this library's word for a key that is encrypted
            problem = "is encrypted, and a run cannot ask for its password"
        except (ValueError, UnsupportedAlgorithm):
            continue
        else:
            if isinstance(key, kind):
                return key
            problem = "is a key of another kind"
    raise UsageError(str(path), problem, "ed25519", _MADE_BY)
