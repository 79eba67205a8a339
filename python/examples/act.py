"""Send a policy to the server, which plays it and returns a trajectory. Uses only gRPC and the protocol in proto/.

A feed-forward policy of random weights plays 200 steps in each of 8 CartPoles, in one round trip. Then this script
computes the policy's values and log-probabilities again, with NumPy. docs/rollouts.md explains the arrays.
Needs grpcio-tools. Start perturb-server, and then run: python act.py [--server unix:/path]
"""

import argparse
import queue
import sys
from pathlib import Path
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2] / "proto/perturb"))
pb = grpc.protos("v1/perturb.proto")  # compiles the file

N, T, HIDDEN = 8, 200, 64
# A network: the weights [out, in] and biases [out] of each layer, from the input to the output.
Layers = list[tuple[NDArray[np.float32], NDArray[np.float32]]]


def network(rng: np.random.Generator, sizes: list[int]) -> Layers:
    """Return a network's layers with random weights."""
    pairs = zip(sizes[1:], sizes, strict=False)
    return [((rng.normal(size=(o, i)) / i**0.5).astype("<f4"), np.zeros(o, "<f4")) for o, i in pairs]


def forward(layers: Layers, rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the output of a network, with tanh after every layer except the last."""
    for weight, bias in layers[:-1]:
        rows = np.tanh(rows @ weight.T + bias)
    return rows @ layers[-1][0].T + layers[-1][1]


def main() -> None:
    """Play in the server, and compare the policy's outputs with this program's own computation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="127.0.0.1:7447", help="unix:/path or host:port")
    options = [("grpc.default_authority", "localhost"), ("grpc.max_receive_message_length", -1)]
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with grpc.insecure_channel(parser.parse_args().server, options=options) as channel:
        responses: Any = channel.stream_stream(
            "/perturb.v1.Perturb/Session",
            request_serializer=pb.SessionRequest.SerializeToString,
            response_deserializer=pb.SessionResponse.FromString,
        )(iter(requests.get, None))

        def call(**request: Any) -> Any:
            requests.put(pb.SessionRequest(**request))
            response = next(responses)
            kind = response.WhichOneof("response")
            if kind == "error":
                raise RuntimeError(f"{response.error.code}: {response.error.message}")
            return getattr(response, kind)

        opened = call(
            open=pb.Open(
                environment="CartPole",
                version=pb.VERSION_RANDOM,
                batch_size=N,
                autoreset_mode=pb.AUTORESET_MODE_SAME_STEP,
            )
        )
        inputs, choices = len(opened.environment.observation), len(opened.environment.action.discrete.names)
        rng = np.random.default_rng(1)
        actor, critic = (network(rng, [inputs, HIDDEN, HIDDEN, outputs]) for outputs in (choices, 1))
        weights = b"".join(array.tobytes() for layer in actor + critic for array in layer)
        training = pb.RandomStream(key=bytes(32))
        acted = call(act=pb.Act(policy=pb.Policy(hidden=[HIDDEN, HIDDEN], training=training), weights=weights, steps=T))
        requests.put(None)

    observations = np.frombuffer(acted.observations, "<f4").reshape(T, N, inputs)
    actions = np.frombuffer(acted.actions, "<i4").reshape(T, N)
    logits = forward(actor, observations)
    chosen = np.take_along_axis(logits, actions[:, :, None], axis=2)[:, :, 0]
    log_probs = chosen - np.log(np.exp(logits).sum(axis=2))
    differences = [
        np.abs(np.frombuffer(theirs, "<f4").reshape(T, N) - own).max()
        for theirs, own in ((acted.log_probs, log_probs), (acted.values, forward(critic, observations)[:, :, 0]))
    ]
    returns = [getattr(end.end, "return") for end in acted.ended]
    print(f"{acted.steps} steps of {N} environments, finished: {acted.finished}")
    print(f"{len(returns)} episodes ended, mean return {np.mean(returns):.1f}")
    print(f"log-probabilities and values differ from NumPy's by at most {max(differences):.0e}")


if __name__ == "__main__":
    main()
