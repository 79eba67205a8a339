"""Runs the compliance cases of the package dm-env-rpc, unchanged, against a running server.

    compliance.py HOST:PORT ENVIRONMENT...

This file only defines how the cases reach a world. Exits with 1 unless every case of every environment passes.
"""

import sys
import unittest

import grpc
from absl.testing import absltest
from dm_env import test_utils
from dm_env_rpc.v1 import compliance, connection, dm_env_adaptor, tensor_utils
from dm_env_rpc.v1 import dm_env_rpc_pb2 as rpc

CASES = 44


def cases(address: str, environment: str) -> list[type[unittest.TestCase]]:
    """Returns the package's six classes of cases, for one environment."""
    required = {"env_id": tensor_utils.pack_tensor(environment)}
    # Local credentials are the package's default. All cases share a channel, since making a channel takes 0.2 s.
    channel = grpc.secure_channel(address, grpc.local_channel_credentials())

    class World:
        """Gives each case a stream and a world."""

        def setUp(self):
            self._connection = connection.Connection(channel)
            self._world_name = self._connection.send(rpc.CreateWorldRequest(settings=required)).world_name
            super().setUp()

        def tearDown(self):
            super().tearDown()
            self._connection.send(rpc.LeaveWorldRequest())
            self._connection.send(rpc.DestroyWorldRequest(world_name=self._world_name))
            self._connection.close()

        @property
        def connection(self):
            return self._connection

        @property
        def world_name(self):
            return self._world_name

        def join_world(self, **request):
            request = request or {"world_name": self._world_name}
            return self._connection.send(rpc.JoinWorldRequest(**request)).specs

    class CreateDestroyWorld(World, compliance.CreateDestroyWorld):
        required_world_settings = required
        has_multiple_world_support = True
        invalid_world_settings = {
            name: tensor_utils.pack_tensor(value)
            for name, value in {
                "colour": "blue",  # unknown
                "version": "X",
                "seed": -1,
                "environment_index": "first",
                "episodes_per_trial": 0,
            }.items()
        }

    class JoinLeaveWorld(World, compliance.JoinLeaveWorld):
        invalid_join_settings = {"seed": tensor_utils.pack_tensor(1)}

    class Reset(World, compliance.Reset):
        pass

    class ResetWorld(World, compliance.ResetWorld):
        pass

    class Step(World, compliance.Step):
        def setUp(self):
            super().setUp()
            self._specs = self.join_world()

        @property
        def specs(self):
            return self._specs

        @property
        def required_actions(self):
            return {uid: _least(spec) for uid, spec in self._specs.actions.items()}

    class Adaptor(World, test_utils.EnvironmentTestMixin, absltest.TestCase):
        def make_object_under_test(self):
            return dm_env_adaptor.DmEnvAdaptor(self.connection, self.join_world())

    return [CreateDestroyWorld, JoinLeaveWorld, Reset, ResetWorld, Step, Adaptor]


def _least(spec: rpc.TensorSpec) -> rpc.Tensor:
    """Returns the minimum of an action. The single element stands for all elements."""
    payload = spec.min.WhichOneof("payload")
    return rpc.Tensor(shape=spec.shape, **{payload: {"array": getattr(spec.min, payload).array[:1]}})


def main(address: str, *environments: str) -> int:
    """Runs the cases, and prints a line for each environment. Returns the exit status."""
    passed = True
    for environment in environments:
        load = unittest.defaultTestLoader.loadTestsFromTestCase
        suite = unittest.TestSuite(load(case) for case in cases(address, environment))
        result = unittest.TextTestRunner(verbosity=1).run(suite)
        bad = len(result.failures) + len(result.errors) + len(result.skipped) + len(result.unexpectedSuccesses)
        print(f"{environment}: {result.testsRun} cases, {bad} not passed", flush=True)
        passed = passed and result.testsRun == CASES and bad == 0
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
