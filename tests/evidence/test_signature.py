"""A signature beside a log: what was signed, by whom, and that any change of log, signature or key is told."""

import json

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519, rsa

from hilrunner import cli
from hilrunner.base import exit_codes
from hilrunner.evidence import signature
from tests.tools import synthetic_run
from tests.tools.error_lines import error_lines

PROFILE = 'name = "signed"\n[[axis]]\nname = "lift"\n[limits]\npressure_mpa_max = 30.0\n'


def written(folder, name, key):
    """(private, public) files of a key as OpenSSL writes them."""
    private, public = folder / f"{name}.pem", folder / f"{name}.pub.pem"
    private.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    public.write_bytes(
        key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    )
    return str(private), str(public)


@pytest.fixture
def signed(tmp_path):
    """(log, private key, public key), the log signed."""
    log = synthetic_run.write_run(tmp_path / "run.mcap", 60, profile_text=PROFILE)
    private, public = written(tmp_path, "ours", ed25519.Ed25519PrivateKey.generate())
    assert cli.main(["sign", str(log), "--key", private]) == 0
    return log, private, public


def test_a_signed_log_is_verified_by_report_and_verify(signed, capsys):
    log, _, public = signed
    assert cli.main(["verify", str(log), "--signed-by", public]) == 0
    assert cli.main(["verify", str(log)]) == 0
    assert cli.main(["report", str(log), "--signed-by", public]) == 0
    text = capsys.readouterr().out
    fingerprint = signature.read_signature(log).fingerprint
    assert fingerprint in text and "signed_by" in text


def test_a_changed_log_is_not_the_one_that_was_signed(signed, capsys):
    """Rewritten with good checksums, as whoever can write a log can do."""
    log, _, public = signed
    synthetic_run.write_run(log, 60, seed=2, profile_text=PROFILE)
    assert cli.main(["report", str(log)]) == exit_codes.DAMAGED
    assert "changed since it was signed" in capsys.readouterr().out
    assert cli.main(["verify", str(log), "--signed-by", public]) == exit_codes.DAMAGED


@pytest.mark.parametrize("key", ["sha256", "size_bytes", "public_key", "signature"])
def test_a_changed_signature_is_told(signed, key):
    log, _, public = signed
    path = signature.signature_path(log)
    table = json.loads(path.read_text())
    old = table[key]
    changed = 1 if key == "size_bytes" else old[:10] + ("a" if old[10] != "a" else "b") + old[11:]
    path.write_text(json.dumps(table | {key: changed}))
    assert cli.main(["verify", str(log)]) == exit_codes.DAMAGED
    assert cli.main(["verify", str(log), "--signed-by", public]) == exit_codes.DAMAGED


def test_a_key_of_somebody_else_does_not_do(signed, tmp_path, capsys):
    log, _, _ = signed
    _, other = written(tmp_path, "other", ed25519.Ed25519PrivateKey.generate())
    assert cli.main(["report", str(log), "--signed-by", other]) == exit_codes.VERDICT_FAILED
    assert "signed by SHA256:" in capsys.readouterr().out


def test_a_log_without_a_signature_fails_only_where_one_is_asked_for(signed):
    log, _, public = signed
    signature.signature_path(log).unlink()
    assert cli.main(["verify", str(log)]) == 0
    assert cli.main(["verify", str(log), "--signed-by", public]) == exit_codes.VERDICT_FAILED


def test_what_is_no_signature_and_no_key_is_refused_in_one_line(signed, tmp_path, capsys):
    log, private, public = signed
    rsa_private, rsa_public = written(tmp_path, "rsa", rsa.generate_private_key(65537, 2048))
    assert cli.main(["sign", str(log), "--key", private]) == exit_codes.BAD_INPUT, "a signature is not replaced unasked"
    for words in (
        ["sign", str(log), "--overwrite", "--key", public],
        ["sign", str(log), "--overwrite", "--key", rsa_private],
        ["sign", str(log), "--overwrite", "--key", str(tmp_path / "none.pem")],
        ["verify", str(log), "--signed-by", rsa_public],
        ["verify", str(log), "--signed-by", str(log)],
        ["run", "--stimulus", "hold", "--no-log", "--sign", private],
    ):
        capsys.readouterr()
        assert cli.main(words) == exit_codes.BAD_INPUT, words
        assert len(error_lines(capsys.readouterr().err)) == 1
    for text in ("", "[]", "{}", '{"format": 1}', "\x00", "[" * 100_000):
        signature.signature_path(log).write_text(text)
        assert cli.main(["verify", str(log)]) == exit_codes.BAD_INPUT


def test_a_damaged_log_is_not_signed(signed):
    log, private, _ = signed
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    log.write_bytes(data)
    assert cli.main(["sign", str(log), "--key", private, "--overwrite"]) == exit_codes.DAMAGED


def test_without_the_extra_a_signature_is_left_alone_unless_it_is_asked_for(signed, monkeypatch, capsys):
    log, private, public = signed
    monkeypatch.setitem(__import__("sys").modules, "cryptography.hazmat.primitives", None)
    assert cli.main(["report", str(log)]) == 0
    capsys.readouterr()
    assert cli.main(["report", str(log), "--signed-by", public]) == exit_codes.BAD_INPUT
    assert "hilrunner[sign]" in capsys.readouterr().err
