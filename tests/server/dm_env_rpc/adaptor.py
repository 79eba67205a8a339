"""Tests a running server with the adaptor of the package dm-env-rpc: adaptor.py HOST:PORT DOCUMENT.

The document is docs/dm_env_rpc.md, whose examples must run. Exits with 1 unless every case passes.
"""

import re
import subprocess
import sys
import unittest
from pathlib import Path

import dm_env
import numpy as np
from dm_env_rpc.v1 import connection, dm_env_adaptor, error
from dm_env_rpc.v1.extensions import properties

ADDRESS, DOCUMENT = sys.argv[1:]


class Adaptor(unittest.TestCase):
    """Tests the adaptor; each case makes its own world."""

    def setUp(self):
        self.connection = connection.create_secure_channel_and_connect(ADDRESS, timeout=60)
        self.addCleanup(self.connection.close)

    def world(self, env_id, **settings):
        """Makes a world and joins it. Returns the environment of the adaptor."""
        settings = {"env_id": env_id, **settings}
        return dm_env_adaptor.create_and_join_world(self.connection, settings, {}, extensions=self.extensions())[0]

    def extensions(self):
        return {"properties": properties.PropertiesExtension(self.connection)}

    def play(self, env, action):
        """Plays an episode with the same action in each step. Returns its time steps, without the first."""
        self.assertTrue(env.reset().first())
        steps = []
        while not steps or not steps[-1].last():
            steps.append(env.step({"action": action}))
        return steps

    def test_the_specs_are_what_agents_expect(self):
        env = self.world("CartPole")
        self.assertEqual(env.action_spec()["action"].num_values, 2)
        self.assertEqual(env.action_spec()["action"].dtype, np.int32)
        self.assertEqual(env.observation_spec()["observation"].shape, (4,))
        self.assertEqual(set(env.observation_spec()), {"observation", "truncated", "success", "diverged"})
        self.assertEqual(env.reward_spec().dtype, np.float32)
        env.close()
        env = self.world("perturb/Pendulum-v1")
        spec = env.action_spec()["action"]
        self.assertEqual((spec.shape, spec.dtype, spec.minimum, spec.maximum), ((1,), np.float32, -2.0, 2.0))
        np.testing.assert_array_equal(env.observation_spec()["observation"].maximum, np.float32([1, 1, 8]))

    def test_a_true_end_has_discount_0(self):
        steps = self.play(self.world("CartPole", seed=1), 1)
        self.assertLess(len(steps), 200)
        self.assertEqual([step.discount for step in steps], [1.0] * (len(steps) - 1) + [0.0])
        self.assertEqual({float(step.reward) for step in steps}, {1.0})
        self.assertFalse(steps[-1].observation["truncated"])
        self.assertFalse(steps[-1].observation["success"])

    def test_a_time_limit_has_discount_1(self):
        steps = self.play(self.world("Pendulum"), np.zeros(1))
        self.assertEqual(len(steps), 200)
        self.assertEqual({step.discount for step in steps}, {1.0})
        self.assertEqual([bool(step.observation["truncated"]) for step in steps], [False] * 199 + [True])

    def test_a_step_after_the_end_begins_the_next_episode(self):
        env = self.world("CartPole")
        last = self.play(env, 0)[-1]
        first = env.step({"action": 0})
        self.assertEqual(first.step_type, dm_env.StepType.FIRST)
        self.assertIsNone(first.reward)
        self.assertLess(np.abs(first.observation["observation"]).max(), 0.05)
        self.assertGreater(np.abs(last.observation["observation"]).max(), 0.05)

    def test_properties_are_a_dictionary(self):
        env = self.world("CartPole", version="R", seed=3, mass=0.25)
        specs = env.properties.specs()
        self.assertTrue(specs["seed"].writable and specs["parameters"].listable and specs["step_limit"].readable)
        self.assertIsNone(specs["parameters"].spec)
        self.assertIn("CartPole", env.properties["environments"])
        self.assertEqual(env.properties["seed"], 3)
        self.assertEqual(env.properties["parameters.mass"], 0.25)
        force = env.properties.specs("parameters")["parameters.force"]
        self.assertEqual((force.spec.minimum, force.spec.maximum, force.writable), (0.0, 1000.0, True))
        env.properties["parameters.force"] = 12.5
        env.properties["seed"] = 9
        self.assertNotEqual(env.properties["parameters.force"], 12.5)
        self.assertTrue(env.reset().first())
        self.assertEqual(env.properties["parameters.force"], 12.5)
        self.assertEqual(env.properties["applied.force"], 12.5)
        self.assertEqual(env.properties["applied.total_mass"], 1.25)
        self.assertEqual(env.properties["seed"], 9)

    def test_refusals_are_pythons_exceptions(self):
        env = self.world("CartPole")
        with self.assertRaises(KeyError):
            env.properties["parameters.gravity"]
        with self.assertRaises(PermissionError):
            env.properties["step_limit"] = 5
        with self.assertRaises(ValueError):
            env.properties["parameters.mass"] = -1.0
        env.reset()
        with self.assertRaisesRegex(error.DmEnvRpcError, "action 1 is 2 in element 0.*within .0, 1."):
            env.step({"action": 2})
        self.assertTrue(env.step({"action": 1}).mid())

    def test_the_documents_examples_run(self):
        examples = re.findall(r"```python\n(.*?)```", Path(DOCUMENT).read_text(encoding="utf-8"), re.DOTALL)
        self.assertGreater(len(examples), 0)
        for example in examples:
            self.assertIn("127.0.0.1:7447", example)
            program = example.replace("127.0.0.1:7447", ADDRESS)
            done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
            self.assertEqual((done.returncode, done.stderr), (0, ""))
            self.assertNotEqual(done.stdout, "")


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1])
