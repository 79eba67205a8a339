"""Export of trained policies to other frameworks: torch modules and ONNX models."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import PolicyError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from . import _native

# Constants of the observation normaliser (docs/checkpoints.md): the number added to variances before the square root,
# and the bound to which normalised observations are clipped.
_EPSILON, _BOUND = 1e-8, 10.0
# The version of ONNX's operator set, which has all operators used here, and the file format version that goes with it.
_OPSET, _IR_VERSION = 17, 8


@dataclass(frozen=True)
class Network:
    """The arrays of a policy network, in the order in which an observation passes through them.

    An observation is normalised. It then passes through hidden layers with tanh, an LSTM if there is one, and a linear
    output layer.
    """

    # Observations x are normalised to clip((x - mean) / deviation, -bound, bound). The three arrays are float64 [O].
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]
    bound: NDArray[np.float64]
    # Weights [out, in] and biases [out] of the hidden layers.
    hidden: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]
    # The LSTM's input weights [4H, in], recurrent weights [4H, H] and biases [4H], with the gates in the order i, f, g,
    # o. None for a feed-forward policy.
    lstm: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]] | None
    # Weights and biases of the output layer, which returns logits or means.
    head: tuple[NDArray[np.float32], NDArray[np.float32]]


def read(policy: _native.Policy) -> Network:
    """Read the arrays of a policy network from the policy's checkpoint.

    Raises:
        PolicyError: if the policy is an RL² policy, because exported networks have no inputs for actions and rewards.
    """
    if policy.sees_rewards:
        raise PolicyError(
            f"the policy {policy.id} also takes actions and rewards as inputs (RL²), which exported networks do not "
            "support: use policy.actor()"
        )
    with tempfile.TemporaryDirectory(prefix="perturb-") as folder:
        policy.save(folder)
        document = json.loads((Path(folder) / "checkpoint.json").read_text("utf-8"))
        data = (Path(folder) / document["weights"]["file"]).read_bytes()
    arrays = _safetensors(data)
    mean, deviation, bound = _moments(document["observation_normaliser"], policy.observation_size)
    recurrent = "lstm.bias" in arrays
    layers = []
    names = [f"hidden.{i}" for i in range(2)] if recurrent else [f"policy.{i}" for i in range(2)]
    layers = [(arrays[f"{name}.weight"], arrays[f"{name}.bias"]) for name in names if f"{name}.weight" in arrays]
    last = "policy" if recurrent else max(name.removesuffix(".weight") for name in arrays if _is_policy_layer(name))
    if not recurrent and f"{last}.weight" in arrays and layers and layers[-1][0] is arrays[f"{last}.weight"]:
        layers.pop()  # with fewer than two hidden layers, the last one found is the output layer
    lstm = (arrays["lstm.input.weight"], arrays["lstm.recurrent.weight"], arrays["lstm.bias"]) if recurrent else None
    return Network(mean, deviation, bound, tuple(layers), lstm, (arrays[f"{last}.weight"], arrays[f"{last}.bias"]))


def _is_policy_layer(name: str) -> bool:
    return name.startswith("policy.") and name.endswith(".weight")


def _safetensors(data: bytes) -> dict[str, NDArray[np.float32]]:
    start = 8 + int.from_bytes(data[:8], "little")
    header: Mapping[str, Any] = json.loads(data[8:start])
    arrays = {}
    for name, array in header.items():
        if name != "__metadata__":
            low, high = array["data_offsets"]
            arrays[name] = np.frombuffer(data[start + low : start + high], "<f4").reshape(array["shape"]).copy()
    return arrays


def _moments(normalizer: Mapping[str, Any] | None, size: int) -> tuple[NDArray[np.float64], ...]:
    """Return the means, standard deviations and bounds [size] that normalise observations.

    Entries that are not normalised have mean 0, deviation 1 and the greatest float64 as their bound.
    """
    mean, deviation, bound = np.zeros(size), np.ones(size), np.full(size, np.finfo(np.float64).max)
    if normalizer is not None:
        moments = normalizer["moments"]
        n = len(moments["mean"]) - normalizer.get("left_alone", 0)
        variance = np.array(moments["squares"][:n]) / moments["count"] if moments["count"] >= 2 else np.ones(n)
        mean[:n], deviation[:n], bound[:n] = moments["mean"][:n], np.sqrt(variance + _EPSILON), _BOUND
    return mean, deviation, bound


def to_torch(network: Network) -> Any:
    """Convert a network to a torch module; see `Policy.to_torch`."""
    try:
        import torch
    except ImportError as error:
        raise ImportError("to_torch() needs torch, which perturb does not install: pip install torch") from error

    def linear(weight: NDArray[np.float32], bias: NDArray[np.float32] | None) -> Any:
        layer = torch.nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weight))
            if bias is not None:
                layer.bias.copy_(torch.from_numpy(bias))
        return layer

    class PolicyNetwork(torch.nn.Module):  # type: ignore[misc]
        """Maps observations [N, O] to the logits of n discrete actions, [N, n], or to the means of actions, [N, A].

        A recurrent network also takes the memory, and returns the new memory as a second value.
        """

        def __init__(self) -> None:
            super().__init__()
            for name in ("mean", "deviation", "bound"):
                self.register_buffer(name, torch.from_numpy(getattr(network, name)))
            self.hidden = torch.nn.ModuleList(linear(*layer) for layer in network.hidden)
            self.head = linear(*network.head)
            self.recurrent = network.lstm is not None
            if network.lstm is not None:
                self.lstm_input = linear(network.lstm[0], network.lstm[2])
                self.lstm_memory = linear(network.lstm[1], None)

        def forward(self, observations: Any, memory: Any = None, starts: Any = None) -> Any:
            x = (observations.to(self.mean.dtype) - self.mean) / self.deviation
            x = torch.clamp(x, -self.bound, self.bound).to(self.head.weight.dtype)
            for layer in self.hidden:
                x = torch.tanh(layer(x))
            if not self.recurrent:
                return self.head(x)
            size = self.lstm_memory.in_features
            if memory is None:
                memory = (x.new_zeros(len(x), size), x.new_zeros(len(x), size))
            h, c = memory
            if starts is not None:
                kept = 1 - torch.as_tensor(starts, device=x.device).to(x.dtype)[:, None]
                h, c = h * kept, c * kept
            # The LSTM's gates: input, forget, cell and output.
            i, f, g, o = (self.lstm_input(x) + self.lstm_memory(h)).chunk(4, dim=1)
            c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
            h = torch.sigmoid(o) * torch.tanh(c)
            return self.head(h), (h, c)

    return PolicyNetwork().eval()


def to_onnx(network: Network, path: str) -> None:
    """Write a network as an ONNX model; see `Policy.to_onnx`."""
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise ImportError("to_onnx() needs onnx, which perturb does not install: pip install onnx") from error
    nodes: list[Any] = []
    constants: list[Any] = []

    def constant(name: str, array: NDArray[Any]) -> str:
        constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def node(kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def linear(x: str, name: str, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> str:
        inputs = [x, constant(f"{name}.weight", weight), constant(f"{name}.bias", bias)]
        return node("Gemm", inputs, f"{name}.output", transB=1)

    # Normalise observations in float64, as the learner does, and apply the hidden layers.
    x = node("Cast", ["observations"], "observations.double", to=TensorProto.DOUBLE)
    x = node("Sub", [x, constant("mean", network.mean)], "centred")
    x = node("Div", [x, constant("deviation", network.deviation)], "scaled")
    x = node("Min", [x, constant("bound", network.bound)], "below")
    x = node("Max", [x, constant("lower_bound", -network.bound)], "clipped")
    x = node("Cast", [x], "normalised", to=TensorProto.FLOAT)
    for place, (weight, bias) in enumerate(network.hidden):
        x = node("Tanh", [linear(x, f"hidden.{place}", weight, bias)], f"hidden.{place}.tanh")
    float32 = TensorProto.FLOAT
    inputs = [helper.make_tensor_value_info("observations", float32, ["N", len(network.mean)])]
    outputs = [helper.make_tensor_value_info("outputs", float32, ["N", len(network.head[1])])]
    if network.lstm is not None:
        # The LSTM with its state as further inputs and outputs of the model.
        size = network.lstm[1].shape[1]
        inputs += [helper.make_tensor_value_info(name, float32, ["N", size]) for name in ("h", "c")]
        outputs += [helper.make_tensor_value_info(name, float32, ["N", size]) for name in ("next_h", "next_c")]
        of_memory = linear("h", "lstm.recurrent", network.lstm[1], np.zeros(4 * size, np.float32))
        gates = node("Add", [linear(x, "lstm.input", network.lstm[0], network.lstm[2]), of_memory], "gates")
        parts = ["gate.i", "gate.f", "gate.g", "gate.o"]
        nodes.append(helper.make_node("Split", [gates, constant("sizes", np.full(4, size))], parts, axis=1))
        i, f, o = (node("Sigmoid", [gate], f"{gate}.sigmoid") for gate in ("gate.i", "gate.f", "gate.o"))
        g = node("Tanh", ["gate.g"], "gate.g.tanh")
        kept, added = node("Mul", [f, "c"], "kept"), node("Mul", [i, g], "added")
        node("Add", [kept, added], "next_c")
        x = node("Mul", [o, node("Tanh", ["next_c"], "next_c.tanh")], "next_h")
    weight, bias = network.head
    head = [x, constant("head.weight", weight), constant("head.bias", bias)]
    nodes.append(helper.make_node("Gemm", head, ["outputs"], transB=1))
    graph = helper.make_graph(nodes, "policy", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
    onnx.checker.check_model(model)
    onnx.save(model, path)
