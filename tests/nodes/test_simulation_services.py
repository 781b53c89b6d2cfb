# SPDX-License-Identifier: Apache-2.0
"""A client that knows simulation_interfaces alone drives a cell in lockstep; holding a run changes no bit."""

import pytest
from cells import config, until

pytest.importorskip("rclpy")
pytest.importorskip("simulation_interfaces")

import rclpy
from action_msgs.msg import GoalStatus
from lathe_rc_msgs.msg import ToolBlock
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import Result, SimulationState, SimulatorFeatures
from simulation_interfaces.srv import GetSimulationState, GetSimulatorFeatures, SetSimulationState, StepSimulation

from lathe_rc import harness, security
from lathe_rc.bag import reader

STEPS = 250


class Client:
    """A client of a simulator, in its namespace."""

    def __init__(self, node):
        self._node = node
        self._clients = {}

    def call(self, kind, name, **values):
        if name not in self._clients:
            self._clients[name] = self._node.create_client(kind, f"/{name}")
            assert self._clients[name].wait_for_service(120.0), "the first start on a machine compiles kernels"
        future = self._clients[name].call_async(kind.Request(**values))
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=120.0)
        return future.result()

    @property
    def state(self):
        return self.call(GetSimulationState, "get_simulation_state").state.state

    def set(self, state):
        answer = self.call(SetSimulationState, "set_simulation_state", state=SimulationState(state=state)).result
        return answer.result, answer.error_message

    def step(self, steps=1):
        answer = self.call(StepSimulation, "step_simulation", steps=steps).result
        return answer.result, answer.error_message

    def simulate_steps(self, steps, *, cancel=False):
        """Result and feedback of the action; ``cancel``: it is cancelled at its first feedback."""
        told = []
        action = ActionClient(self._node, SimulateSteps, "/simulate_steps")
        try:
            assert action.wait_for_server(120.0)
            sent = action.send_goal_async(SimulateSteps.Goal(steps=steps), lambda each: told.append(each.feedback))
            until(sent.done, self._spin)
            result = sent.result().get_result_async()
            if cancel:
                until(lambda: told, self._spin)
                sent.result().cancel_goal_async()
            until(result.done, self._spin)
            until(lambda: cancel or not steps or (told and not told[-1].remaining_steps), self._spin)
            return result.result(), told
        finally:
            action.destroy()

    def _spin(self):
        rclpy.spin_once(self._node, timeout_sec=0.1)

    def wait_until(self, state):
        until(lambda: self.state == state)


def cell(tmp_path, *overrides):
    given = ["spindle_encoder.revolutions=17.0", "spindle_encoder.speed_factor=0.0", *overrides]
    return harness.with_recorder(config("piston", *given), tmp_path / "bag", keep=True)


@pytest.mark.system
def test_hundreds_of_steps_give_the_digest_of_the_free_run(ghost, domain, tmp_path):
    """Each step is a block that every member completes before the answer; playing on gives the rest."""
    stepped = cell(tmp_path, "window=4", "spindle_encoder.simulation_services=paused")
    latched = QoSProfile(depth=2 * STEPS, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    heard = []
    ghost.create_subscription(ToolBlock, "/tool", heard.append, latched)
    # The tool is alone, so it publishes its first block whether or not DDS has matched the listener already.
    apart = [["spindle_encoder"], ["tool"]]
    others = [name for name in stepped.nodes if [name] not in apart]
    with harness.Processes(stepped, [*apart, others], domain=domain) as processes:
        client = Client(ghost)
        found = client.call(GetSimulatorFeatures, "get_simulator_features").features
        assert {SimulatorFeatures.STEP_SIMULATION_SINGLE, SimulatorFeatures.SIMULATION_STATE_PAUSE} < {*found.features}
        assert found.custom_info == "a step is 64 samples, 0.001 s"
        client.wait_until(SimulationState.STATE_PAUSED)
        for done in range(1, STEPS + 1):
            assert client.step() == (Result.RESULT_OK, "")
            # No member waits for the listener: it takes each block before the writer's queue drops it.
            until(lambda done=done: len(heard) >= done, lambda: rclpy.spin_once(ghost, timeout_sec=1.0))
        assert client.state == SimulationState.STATE_PAUSED
        assert (len(heard), heard[-1].block.first_index) == (STEPS, (STEPS - 1) * 64)
        assert client.set(SimulationState.STATE_PLAYING) == (Result.RESULT_OK, "")
        processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(cell(tmp_path)).digest


def test_a_run_pauses_goes_on_and_refuses_what_a_cell_cannot_do(ghost, domain, tmp_path):
    """A pause leaves nothing under way; each refusal says why; a step beyond the end says where the run ended."""
    given = ["simulation_services=playing", "speed_factor=0.1", "revolutions=15.0"]
    paced = cell(tmp_path, *(f"spindle_encoder.{text}" for text in given))
    allowed = {profile.node: profile.reply for group in security.policy(paced).values() for profile in group}
    state = SimulationState
    with harness.Processes(paced, [[*paced.nodes]], domain=domain) as processes:
        client = Client(ghost)
        code, why = client.set(state.STATE_PAUSED)
        if code == Result.RESULT_INCORRECT_STATE:  # asked so early
            assert why.startswith("the run has not begun: waits for ")
        else:
            assert client.set(state.STATE_PLAYING) == (Result.RESULT_OK, "")
        client.wait_until(state.STATE_PLAYING)
        offered = {name for name, _ in ghost.get_service_names_and_types_by_node("spindle_encoder", "/")}
        assert offered == {f"/{name}" for name in allowed["spindle_encoder"]}, "the policy allows these, and no others"
        assert client.step() == (Result.RESULT_OPERATION_FAILED, "the run is not paused")
        assert client.set(state.STATE_PAUSED) == (Result.RESULT_OK, "")
        processes.wait_for("held")  # a sign of life: else the harness would end the run after a while
        assert client.set(state.STATE_PAUSED) == (SetSimulationState.Response.ALREADY_IN_TARGET_STATE, "")
        assert client.step(0) == (Result.RESULT_OPERATION_FAILED, "steps = 0; allowed: 1 or more")
        assert client.step(3) == (Result.RESULT_OK, "")
        done, told = client.simulate_steps(4)
        assert (done.status, done.result.result.result) == (GoalStatus.STATUS_SUCCEEDED, Result.RESULT_OK)
        assert (told[-1].completed_steps, told[-1].remaining_steps) == (4, 0)
        assert client.simulate_steps(0)[0].status == GoalStatus.STATUS_ABORTED
        done, told = client.simulate_steps(10**6, cancel=True)
        assert done.status == GoalStatus.STATUS_CANCELED
        assert 0 < told[-1].completed_steps < 10**6
        assert client.state == state.STATE_PAUSED
        code, why = client.set(state.STATE_STOPPED)
        assert code == Result.RESULT_FEATURE_UNSUPPORTED
        assert "reset by starting its processes again" in why
        code, why = client.step(10**6)
        assert (code, why.endswith(": the run is over")) == (Result.RESULT_OPERATION_FAILED, True)
        processes.wait_for_end()
    assert (
        reader.read_bag(tmp_path / "bag").digests()
        == harness.run(cell(tmp_path, "spindle_encoder.revolutions=15.0")).digest
    )
