"""Servers can require tokens or certificates. A client without them gets an error that names what is missing."""

from __future__ import annotations

import datetime
import time
from typing import TYPE_CHECKING, Any, TypeAlias

import gymnasium
import numpy as np
import pytest
import trustme

import perturb

from .conftest import Server, identifier
from .processes import SECONDS, within

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

# The flags of a server, or the environment variables of a client, with the names of their files.
Files: TypeAlias = "dict[str, str]"

# Flags of servers that require credentials.
TLS: Files = {"--tls-cert": "server.pem", "--tls-key": "server.key"}
MUTUAL_TLS: Files = TLS | {"--tls-client-ca": "clients.pem"}
TOKENS: Files = {"--tokens": "tokens.toml"}
# Environment variables of clients with these credentials.
TRUST: Files = {"PERTURB_CA": "servers.pem"}
IDENTITY: Files = TRUST | {"PERTURB_CERT": "client.pem", "PERTURB_KEY": "client.key"}
TOKEN: Files = {"PERTURB_TOKEN_FILE": "token"}
ALL: Files = IDENTITY | TOKEN

TOKENS_TOML = """
[[token]]
name = "ann"
token = "correct-horse-battery"
role = "train"

[[role]]
name = "train"
draws = ["D", "R"]
"""
EXPIRED = datetime.datetime(2021, 1, 1, tzinfo=datetime.timezone.utc)
# A length that E can draw, and R cannot.
EXTREME = {"parameters": {"length": 1.0}}
NOT_ALLOWED = (
    r'a token of the role "train" may not draw from .* of CartPole: .*; request a region that it may draw from'
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with valid and invalid certificates and tokens."""
    folder = tmp_path_factory.mktemp("guarded")
    # The authority `strangers` has the same name as `clients`, but another key.
    servers, clients, strangers = (
        trustme.CA(organization_name="perturb", organization_unit_name=unit)
        for unit in ("servers", "clients", "clients")
    )
    for name, authority in (("servers", servers), ("clients", clients), ("strangers", strangers)):
        authority.cert_pem.write_to_path(folder / f"{name}.pem")

    def issue(name: str, authority: trustme.CA, owner: str, until: datetime.datetime | None = None) -> None:
        issued = authority.issue_cert(owner, not_after=until)
        issued.cert_chain_pems[0].write_to_path(folder / f"{name}.pem")
        issued.private_key_pem.write_to_path(folder / f"{name}.key")

    issue("server", servers, "127.0.0.1")
    issue("expired-server", servers, "127.0.0.1", EXPIRED)
    issue("elsewhere", servers, "example.org")
    issue("client", clients, "ann")
    issue("expired", clients, "ann", EXPIRED)
    issue("stranger", strangers, "ann")
    (folder / "tokens.toml").write_text(TOKENS_TOML)
    (folder / "token").write_text("correct-horse-battery\n")
    (folder / "another").write_text("another-horse-battery\n")
    return folder


def flags(asks: Files, folder: Path) -> list[str]:
    return [part for flag, name in asks.items() for part in (flag, str(folder / name))]


@pytest.fixture
def start(folder: Path, start_server: Callable[..., Server]) -> Callable[[Files], str]:
    """Return a function that starts a server with the given flags, and returns its address."""
    return lambda asks: start_server(*flags(asks, folder), listen="tcp://127.0.0.1:0").address


@pytest.fixture(scope="module")
def guarded(folder: Path, _program: None) -> Iterator[str]:
    """Return the address of a server that requires a token and a client certificate."""
    running = Server(*flags(MUTUAL_TLS | TOKENS, folder), listen="tcp://127.0.0.1:0")
    yield running.address
    running.end()


@pytest.fixture(autouse=True)
def have(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Files], None]:
    """Unset the variables with credentials. Return a function that unsets them again, and then sets the given ones."""

    def have(files: Files) -> None:
        for variable in (*ALL, "PERTURB_INSECURE"):
            monkeypatch.delenv(variable, raising=False)
        for variable, name in files.items():
            monkeypatch.setenv(variable, str(folder / name))

    have({})
    return have


def played(server: str) -> list[bytes]:
    """Return the bytes of all observations in a hundred steps of a batch and of a single environment."""
    envs = perturb.PerturbVectorEnv("CartPole", 3, version="R", server=server)
    observed = [envs.reset(seed=1)[0].tobytes()]
    observed += [envs.step(np.full(3, step // 5 % 2))[0].tobytes() for step in range(100)]
    envs.close()
    env = gymnasium.make(identifier("Hopper"), version="R", server=server)
    observed.append(env.reset(seed=1)[0].tobytes())
    observed.append(env.step(np.zeros(3, dtype=np.float32))[0].tobytes())
    env.close()
    return observed


@pytest.mark.parametrize(
    ("asks", "has"),
    [
        pytest.param(TLS, TRUST, id="tls"),
        pytest.param(MUTUAL_TLS, IDENTITY, id="mutual"),
        pytest.param(TOKENS, TOKEN, id="token"),
        pytest.param(TLS | TOKENS, TRUST | TOKEN, id="tls-token"),
        pytest.param(MUTUAL_TLS | TOKENS, ALL, id="all"),
    ],
)
def test_observations_are_the_same_with_and_without_credentials(
    asks: Files, has: Files, start: Callable[[Files], str], have: Callable[[Files], None], server: str
) -> None:
    address = start(asks)
    assert address.startswith("https://") == ("--tls-cert" in asks)
    have(has)
    assert played(address) == played(server)


@pytest.mark.parametrize(
    ("has", "says"),
    [
        pytest.param(
            ALL | {"PERTURB_CA": "strangers.pem"},
            "no safe connection to the server at {address}: no trusted authority has signed its certificate; "
            "set PERTURB_CA to the authority's certificate",
            id="another-authority",
        ),
        pytest.param(
            TRUST | TOKEN,
            "{address}: it asks for a client's certificate; set PERTURB_CERT and PERTURB_KEY to your files",
            id="no-certificate",
        ),
        pytest.param(
            ALL | {"PERTURB_CERT": "stranger.pem", "PERTURB_KEY": "stranger.key"},
            "{address}: it accepts no client with the certificate of PERTURB_CERT: another authority must sign it",
            id="strangers-certificate",
        ),
        pytest.param(
            ALL | {"PERTURB_CERT": "expired.pem", "PERTURB_KEY": "expired.key"},
            "{address}: the certificate of PERTURB_CERT has expired; have it renewed by its authority",
            id="expired-certificate",
        ),
        pytest.param(
            TRUST | TOKEN | {"PERTURB_CERT": "client.pem"},
            "{address}: PERTURB_CERT is set, but PERTURB_KEY is not; set both or neither",
            id="certificate-without-key",
        ),
        pytest.param(
            IDENTITY,
            "the server at {address} refuses this process: this server requires a token, and none was sent; "
            "ask its operator for one, and name the file that has it in PERTURB_TOKEN_FILE",
            id="no-token",
        ),
        pytest.param(
            ALL | {"PERTURB_TOKEN_FILE": "another"},
            "the server at {address} refuses this process: this server does not know the token that was sent; "
            "ask its operator for a valid one",
            id="wrong-token",
        ),
        pytest.param(
            ALL | {"PERTURB_TOKEN_FILE": "missing"},
            "missing: No such file or directory (os error 2); expected one line with a token",
            id="token-file-missing",
        ),
    ],
)
def test_errors_name_missing_credentials_which_can_then_be_added(
    has: Files, says: str, guarded: str, have: Callable[[Files], None]
) -> None:
    have(has)
    env = perturb.PerturbEnv("CartPole", version="R", server=guarded)
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError) as caught:
        env.reset()
    assert says.format(address=guarded) in str(caught.value)
    assert isinstance(caught.value, ConnectionError)
    have(ALL)
    env.reset(seed=1)
    env.step(0)
    env.close()


@pytest.mark.parametrize(
    ("certificate", "says"),
    [
        ("expired-server", "its certificate has expired; whoever runs it must renew it"),
        ("elsewhere", "its certificate is not for this name"),
    ],
)
def test_a_server_with_an_invalid_certificate_is_refused(
    certificate: str, says: str, start: Callable[[Files], str], have: Callable[[Files], None]
) -> None:
    address = start({"--tls-cert": f"{certificate}.pem", "--tls-key": f"{certificate}.key"})
    have(TRUST)
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match=f"no safe connection .*: {says}"):
        perturb.PerturbEnv("CartPole", server=address).reset()


def test_the_refusal_of_a_wrong_scheme_names_the_right_one(
    guarded: str, start: Callable[[Files], str], have: Callable[[Files], None]
) -> None:
    have(ALL)
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match=f"the server uses TLS; write {guarded}"):
        perturb.PerturbEnv("CartPole", server=guarded.removeprefix("https://")).reset()
    plain = start(TOKENS).removeprefix("http://")
    with within(SECONDS), pytest.raises(perturb.ServerConnectionError, match="write tcp:// instead of https://"):
        perturb.PerturbEnv("CartPole", server=f"https://{plain}").reset()


def test_a_token_is_not_sent_unencrypted_to_another_machine(have: Callable[[Files], None]) -> None:
    """The client raises the error before it connects, so the test needs no machine with this address."""
    have(TOKEN)
    with pytest.raises(
        perturb.ServerConnectionError,
        match=r"the token of PERTURB_TOKEN_FILE would go there unencrypted; write https://192\.0\.2\.1:7447 .* "
        r"or set PERTURB_INSECURE=1",
    ):
        perturb.PerturbEnv("CartPole", server="192.0.2.1:7447").reset()


def test_a_unix_socket_needs_no_credentials(have: Callable[[Files], None], server: str) -> None:
    have({"PERTURB_CA": "missing", "PERTURB_CERT": "missing", "PERTURB_TOKEN_FILE": "missing"})
    for address in (server, None):
        env = perturb.PerturbEnv("CartPole", server=address)
        env.reset()
        env.close()


def test_versions_and_parameters_excluded_by_a_role_are_refused(guarded: str, have: Callable[[Files], None]) -> None:
    have(ALL)
    settings: list[dict[str, Any]] = [{"version": "E"}, {"version": "R+E"}, EXTREME]
    for wrong in settings:
        with pytest.raises(perturb.NotAllowedError, match=NOT_ALLOWED) as caught:
            perturb.PerturbEnv("CartPole", server=guarded, **wrong).reset()
        assert isinstance(caught.value, PermissionError)


def test_a_reset_that_a_role_does_not_allow_changes_nothing(
    guarded: str, have: Callable[[Files], None], server: str
) -> None:
    have(ALL)
    env, twin = (perturb.PerturbEnv("CartPole", version="R", server=address) for address in (guarded, server))
    for one in (env, twin):
        one.reset(seed=1)
    with pytest.raises(perturb.NotAllowedError, match=NOT_ALLOWED):
        env.reset(options=EXTREME)
    assert env.step(1)[0].tobytes() == twin.step(1)[0].tobytes()
    assert env.reset(seed=2)[1] == twin.reset(seed=2)[1]
    env.close()
    twin.close()


def step_until_error(envs: perturb.PerturbVectorEnv) -> None:
    while True:
        envs.step(np.zeros(envs.num_envs, dtype=np.int64))
        time.sleep(0.05)


def test_sessions_end_when_their_token_is_revoked(
    start_server: Callable[..., Server], have: Callable[[Files], None], tmp_path: Path
) -> None:
    tokens = tmp_path / "tokens.toml"
    tokens.write_text(TOKENS_TOML)
    address = start_server("--tokens", str(tokens), listen="tcp://127.0.0.1:0").address
    have(TOKEN)
    envs = perturb.PerturbVectorEnv("CartPole", 2, server=address)
    expected = envs.reset(seed=1)[0].tobytes()
    tokens.write_text(TOKENS_TOML.replace("correct-horse", "another-horse"))
    with (
        within(SECONDS),
        pytest.raises(perturb.ServerConnectionError, match='refuses this process: the token "ann" was revoked'),
    ):
        step_until_error(envs)
    with pytest.raises(perturb.OutOfOrderError, match=r"call reset\(\) to open a new one.* was revoked"):
        envs.step(np.zeros(2, dtype=np.int64))
    with pytest.raises(perturb.ServerConnectionError, match="does not know the token"):
        envs.reset()
    have({"PERTURB_TOKEN_FILE": "another"})
    assert envs.reset(seed=1)[0].tobytes() == expected
    envs.close()
