"""The client refuses replies of servers that violate the protocol or have another version."""

from __future__ import annotations

import tempfile
import time
from concurrent import futures
from typing import TYPE_CHECKING, Any

import grpc
import numpy as np
import pytest

import perturb

from .conftest import messages

if TYPE_CHECKING:
    from collections.abc import Iterator

NAN, INF = float("nan"), float("inf")
pb = messages()
Answer = pb.SessionResponse


class FakeServer:
    """A fake server. Each item of `answers` answers one request of a session.

    It is a message, a list of messages, or the text of an error that ends the session.
    """

    def __init__(self, method: str = "Session") -> None:
        self._directory = tempfile.TemporaryDirectory(prefix="perturb-test-")
        self.address = f"unix:{self._directory.name}/fake.sock"
        self.answers: list[Any] = []
        self.sessions = 0
        handler = grpc.stream_stream_rpc_method_handler(
            self._session, pb.SessionRequest.FromString, pb.SessionResponse.SerializeToString
        )
        self._server = grpc.server(futures.ThreadPoolExecutor(4))
        self._server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler("perturb.v1.Perturb", {method: handler}),)
        )
        self._server.add_insecure_port(self.address)
        self._server.start()

    def _session(self, requests: Iterator[Any], context: grpc.ServicerContext) -> Iterator[Any]:
        self.sessions += 1
        for answer, _request in zip(self.answers, requests, strict=False):
            if isinstance(answer, str):
                context.abort(grpc.StatusCode.FAILED_PRECONDITION, answer)
            yield from answer if isinstance(answer, list) else [answer]

    def end(self) -> None:
        self._server.stop(None).wait()
        self._directory.cleanup()


def opened() -> Any:
    channels = [pb.Channel(name=str(i), low=-float("inf"), high=float("inf")) for i in range(4)]
    action = pb.ActionSpace(discrete=pb.Discrete(names=["left", "right"]))
    environment = pb.Environment(
        name="CartPole", revision=1, observation=channels, action=action, control_timestep=0.02
    )
    return pb.Opened(environment=environment, observations=bytes(16))


def reset_done() -> Any:
    return pb.ResetDone(observations=bytes(16))


def stepped() -> Any:
    return pb.Stepped(observations=bytes(16), rewards=bytes(4), terminated=bytes(1), truncated=bytes(1))


def ended(**outcome: Any) -> Any:
    end = pb.EpisodeEnd(**outcome)
    return pb.Stepped(
        observations=bytes(16),
        rewards=bytes(4),
        terminated=b"\1",
        truncated=bytes(1),
        final_observations=bytes(16),
        ended=[end],
    )


@pytest.fixture
def fake() -> Iterator[FakeServer]:
    server = FakeServer()
    yield server
    server.end()


def test_a_server_that_keeps_to_the_protocol_is_accepted(fake: FakeServer) -> None:
    """The client accepts a fake server that keeps to the protocol.

    Each refusal in the tests below is therefore due to that test's violation.
    """
    fake.answers = [Answer(opened=opened()), Answer(stepped=stepped())]
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    assert env.step(0)[1:] == (0.0, False, False, {})
    env.close()


@pytest.mark.parametrize(("outcome", "achieved"), [({"achieved": 0.5}, 0.5), ({}, NAN)])
def test_achieved_is_the_reported_value_or_nan(outcome: dict[str, float], achieved: float, fake: FakeServer) -> None:
    fake.answers = [Answer(opened=opened()), Answer(stepped=ended(**outcome))] * 2
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    info = env.step(0)[-1]
    np.testing.assert_equal(info, {"is_success": False, "diverged": False, "achieved": achieved})
    envs = perturb.PerturbVectorEnv("CartPole", server=fake.address)
    envs.reset()
    infos = envs.step([0])[-1]
    np.testing.assert_equal(infos["achieved"], np.array([achieved]))
    assert infos["_achieved"].all()


def test_server_without_observed_parameters_is_refused(fake: FakeServer) -> None:
    fake.answers = [Answer(opened=opened())]
    with pytest.raises(perturb.ProtocolError, match="does not know observe='parameters': it is older"):
        perturb.PerturbEnv("CartPole", server=fake.address, observe="parameters").reset()


def test_another_revision_of_an_environment_is_refused(fake: FakeServer) -> None:
    other = opened()
    other.environment.revision = 3
    fake.answers = [Answer(opened=other)]
    with pytest.raises(perturb.ProtocolError, match="revision 3 of CartPole, this package has 1: install"):
        perturb.PerturbEnv("CartPole", server=fake.address).reset()


def test_a_reply_of_another_kind_is_refused(fake: FakeServer) -> None:
    fake.answers = [Answer(opened=opened()), Answer(reset=reset_done())]
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    with pytest.raises(perturb.ProtocolError, match="answered step with reset"):
        env.step(0)
    with pytest.raises(perturb.OutOfOrderError, match=r"call reset\(\) to open a new one"):
        env.step(0)


def test_an_empty_reply_is_refused(fake: FakeServer) -> None:
    fake.answers = [Answer()]
    with pytest.raises(perturb.ProtocolError, match="answered open with an empty reply"):
        perturb.PerturbEnv("CartPole", server=fake.address).reset()


@pytest.mark.parametrize("field", ["observations", "rewards"])
def test_arrays_of_a_wrong_length_are_refused(field: str, fake: FakeServer) -> None:
    short = stepped()
    setattr(short, field, bytes(3))
    fake.answers = [Answer(opened=opened()), Answer(stepped=short)]
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    with pytest.raises(perturb.ProtocolError, match="3 bytes"):
        env.step(0)


def floats(*numbers: float) -> bytes:
    return np.array(numbers, "<f4").tobytes()


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"rewards": floats(NAN)}, "the reward NaN of slot 0; expected a finite number"),
        ({"rewards": floats(INF)}, "the reward inf of slot 0"),
        ({"observations": floats(0, 0, NAN, 0)}, "the number NaN in the observation of slot 0"),
        ({"terminated": b"\7"}, "the flag 7 of terminated in slot 0; expected 0 or 1"),
        ({"truncated": b"\2"}, "the flag 2 of truncated in slot 0"),
        ({"terminated": b"\1"}, "0 ended episodes; expected 1, the number of environments flagged as ended"),
        ({"ended": [pb.EpisodeEnd()], "final_observations": bytes(16)}, "slot 0, which is not flagged as ended"),
    ],
)
def test_replies_with_impossible_values_are_refused(fields: dict[str, Any], says: str, fake: FakeServer) -> None:
    good = {"observations": bytes(16), "rewards": bytes(4), "terminated": bytes(1), "truncated": bytes(1)}
    fake.answers = [Answer(opened=opened()), Answer(stepped=pb.Stepped(**{**good, **fields}))]
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    with pytest.raises(perturb.ProtocolError, match=says):
        env.step(0)


def test_first_observations_that_are_not_finite_are_refused(fake: FakeServer) -> None:
    wrong = opened()
    wrong.observations = floats(0, NAN, 0, 0)
    fake.answers = [Answer(opened=wrong)]
    with pytest.raises(perturb.ProtocolError, match="the number NaN in the observation"):
        perturb.PerturbEnv("CartPole", server=fake.address).reset()


def test_a_second_reply_to_one_request_is_refused(fake: FakeServer) -> None:
    other = stepped()
    other.rewards = floats(7)
    fake.answers = [
        Answer(opened=opened()),
        [Answer(stepped=stepped()), Answer(stepped=other)],
        Answer(stepped=stepped()),
    ]
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    assert env.step(0)[1] == 0
    time.sleep(0.5)  # meanwhile the keepalive thread polls the session, so the second reply arrives
    with pytest.raises(perturb.ProtocolError, match="a second reply to an earlier request"):
        env.step(0)
    with pytest.raises(perturb.OutOfOrderError, match=r"call reset\(\) to open a new one"):
        env.step(0)


def test_a_defect_of_the_server_ends_the_session(fake: FakeServer) -> None:
    fake.answers = [Answer(opened=opened()), Answer(error=pb.Error(code=13, message="a worker died"))]
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    with pytest.raises(perturb.ServerDefectError, match="a worker died"):
        env.step(0)
    with pytest.raises(perturb.OutOfOrderError, match="a worker died"):
        env.step(0)
    env.reset()
    assert fake.sessions == 2


@pytest.mark.parametrize(
    ("code", "error"),
    [
        (3, perturb.InvalidArgumentError),
        (5, perturb.UnknownNameError),
        (7, perturb.NotAllowedError),
        (8, perturb.ServerFullError),
        (9, perturb.OutOfOrderError),
        (14, perturb.ServerUnavailableError),
        (2, perturb.ProtocolError),
    ],
)
def test_a_refusal_does_not_end_the_session(code: int, error: type[Exception], fake: FakeServer) -> None:
    refused = Answer(error=pb.Error(code=code, message="the reason"))
    fake.answers = [Answer(opened=opened()), refused, Answer(stepped=stepped())]
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    env.reset()
    with pytest.raises(error, match="the reason"):
        env.step(0)
    env.step(0)
    assert fake.sessions == 1


def test_a_stream_that_ends_is_reported(fake: FakeServer) -> None:
    fake.answers = [Answer(opened=opened())]
    env = perturb.PerturbEnv("CartPole", server=fake.address, timeout=5)
    env.reset()
    fake.end()
    with pytest.raises(perturb.ServerConnectionError, match="lost the server"):
        env.step(0)


# A text that colours a terminal, sets its title, clears it and reverses the direction of text.
HOSTILE = "hostile \x1b[31mred\x1b]0;title\x07\x9b2J\u202e"


def hostile_environment() -> Any:
    """Return an opened session whose environment has hostile texts."""
    other = opened()
    other.environment.parameters.append(pb.Parameter(name=HOSTILE, unit=HOSTILE, default_value=1.0, applied=HOSTILE))
    other.environment.applied.append(pb.Quantity(name=HOSTILE, unit=HOSTILE))
    other.environment.model_hash = HOSTILE
    receipt = pb.Receipt(requested=[1.0], applied=[1.0], model_hash=HOSTILE)
    other.started.append(pb.EpisodeStart(episode=pb.Episode(), receipt=receipt))
    return other


def reset_and_step(env: perturb.PerturbEnv) -> None:
    env.reset()
    env.step(0)


@pytest.mark.parametrize(
    "answers",
    [
        [HOSTILE],
        [Answer(error=pb.Error(code=9, message=HOSTILE))],
        [Answer(opened=opened()), HOSTILE],
        [Answer(opened=opened()), Answer(error=pb.Error(code=13, message=HOSTILE))],
    ],
    ids=["call", "open", "stream", "step"],
)
def test_texts_of_a_hostile_server_are_escaped_in_errors(answers: list[Any], fake: FakeServer) -> None:
    fake.answers = answers
    env = perturb.PerturbEnv("CartPole", server=fake.address)
    with pytest.raises(perturb.PerturbError, match=r"hostile \\u\{1b\}\[31mred") as caught:
        reset_and_step(env)
    assert str(caught.value).isprintable()


def test_names_of_a_hostile_server_are_escaped_in_infos(fake: FakeServer) -> None:
    fake.answers = [Answer(opened=hostile_environment())]
    _, info = perturb.PerturbEnv("CartPole", server=fake.address, receipts=True).reset()
    for values in (info["parameters"], info["receipt"]["applied"]):
        (name,) = values
        assert name.startswith(r"hostile \u{1b}[31mred")
        assert name.isprintable()


def test_a_server_of_another_service_is_refused() -> None:
    other = FakeServer("SomethingElse")
    with pytest.raises(perturb.ProtocolError, match="not a perturb-server"):
        perturb.PerturbEnv("CartPole", server=other.address).reset()
    other.end()


def reset_with_answers(env: perturb.PerturbEnv, fake: FakeServer, *answers: Any) -> perturb.PerturbEnv:
    fake.answers = [Answer(opened=opened()), *answers]
    env.reset()
    return env


@pytest.mark.parametrize(
    ("code", "message", "says"),
    [
        (9, "libEGL.so.1 is missing; install libegl1", "^libEGL.so.1 is missing; install libegl1$"),
        (3, "request is empty or of a kind this server does not know", "may be older than this package: request is"),
    ],
)
def test_a_session_continues_after_a_failed_render(code: int, message: str, says: str, fake: FakeServer) -> None:
    env = perturb.PerturbEnv("CartPole", server=fake.address, render_mode="rgb_array")
    reset_with_answers(env, fake, Answer(error=pb.Error(code=code, message=message)), Answer(stepped=stepped()))
    with pytest.raises(perturb.RenderError, match=says) as caught:
        env.render()
    assert isinstance(caught.value, RuntimeError)
    assert env.step(0)[1:] == (0.0, False, False, {})
    assert fake.sessions == 1


@pytest.mark.parametrize(
    "rendered",
    [
        pb.Rendered(pixels=bytes(20 * 16 * 3), width=16, height=20),
        pb.Rendered(pixels=bytes(20 * 16 * 3 - 1), width=20, height=16),
        pb.Rendered(),
    ],
)
def test_a_picture_of_another_size_is_refused(rendered: Any, fake: FakeServer) -> None:
    env = perturb.PerturbEnv("CartPole", server=fake.address, render_mode="rgb_array", width=20, height=16)
    good = pb.Rendered(pixels=bytes(range(240)) * 4, width=20, height=16)
    picture = reset_with_answers(env, fake, Answer(render=good), Answer(render=rendered)).render()
    assert picture.shape == (16, 20, 3)
    assert picture[0, 1].tolist() == [3, 4, 5]
    assert picture[1, 0].tolist() == [60, 61, 62]
    with pytest.raises(perturb.ProtocolError, match=r"expected \[16, 20, 3\]"):
        env.render()
