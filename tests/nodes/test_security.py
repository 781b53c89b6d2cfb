# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policies against the ROS graph of real cells, and the discovery that stays on this machine."""

import contextlib
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import rclpy
from cells import SCENARIOS, scenario, until
from click.testing import CliRunner
from lathe_rc_msgs.msg import CellState
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import NodeNameNonExistentError

from lathe_rc import cli, harness, process_launcher, security
from lathe_rc.catalogue import STANDALONE
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.beside import MACHINE_STATE, REPLAYER, RERUN_BRIDGE, TOPIC_RECORDER
from lathe_rc.cell.host_topics import HOST_TOPICS
from lathe_rc.cell.scenario import TABLES
from lathe_rc.nodes.ports import latched_qos

CONFIG = Path(__file__).parents[2] / "config"
FILES = sorted((CONFIG / "security").glob("*.policy.xml"))
GRACE = 20.0  # [s] for a process to end on SIGTERM


def named(path):
    """The scenario of a policy file."""
    return path.name.removesuffix(".policy.xml")


def made(*arguments):
    result = CliRunner().invoke(cli.main, ["policy", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    return result.output


def parsed(text):
    """Root of a policy."""
    return ET.fromstring(text)  # noqa: S314 - made here


# ---- the files


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_files_are_what_the_command_makes(path):
    assert path.read_text(encoding="utf-8") == made(named(path)), f"./lathe policy {named(path)} -o {path}"


def test_there_are_files():
    assert {named(path) for path in FILES} >= {"piston", "two_channel", "full_cell"}


#: elements below an element, and its attributes: the schema of SROS2 0.2.0, as far as it is used here
CHILDREN = {
    "policy": {"enclaves"},
    "enclaves": {"enclave"},
    "enclave": {"profiles"},
    "profiles": {"profile"},
    "profile": {"topics", "services"},
    "topics": {"topic"},
    "services": {"service"},
    "topic": set(),
    "service": set(),
}
ATTRIBUTES = {"policy": {"version"}, "enclave": {"path"}, "profile": {"ns", "node"}}
RULES = {"topics": {"publish", "subscribe"}, "services": {"reply", "request"}}


def check_structure(element):
    if element.tag in RULES:
        ((rule, verdict),) = element.attrib.items()
        assert rule in RULES[element.tag]
        assert verdict == "ALLOW"
    else:
        assert set(element.attrib) == ATTRIBUTES.get(element.tag, set())
    assert {child.tag for child in element} <= CHILDREN[element.tag]
    assert len(element) or not CHILDREN[element.tag]
    assert bool((element.text or "").strip()) == (not CHILDREN[element.tag])
    for child in element:
        check_structure(child)


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_every_scenario_has_a_policy(path):
    root = parsed(made(path, *(word for kind in security.BESIDE for word in ("--with", kind))))
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    check_structure(root)
    paths = [enclave.get("path") for enclave in root.iter("enclave")]
    assert len(set(paths)) == len(paths)


# ---- the least privilege


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_a_signal_has_one_publisher(path):
    loaded = scenarios.load(path)
    profiles = [profile for enclave in security.policy(loaded, groups=[]).values() for profile in enclave]
    common = frozenset.intersection(*(profile.publish for profile in profiles))
    topics = [topic for profile in profiles for topic in profile.publish - common]
    assert len(set(topics)) == len(topics)


def test_nodes_of_a_process_share_an_enclave_and_read_each_other_in_memory():
    loaded = scenario()
    alone = security.policy(loaded)
    grouped = security.policy(loaded, groups=[["learning_controller", "electrodynamic_actuator"]], namespace="/a/b")
    assert list(grouped) == ["/a/b/learning_controller", "/a/b/spindle_encoder", "/a/b/tool", "/a/b/recorder"]
    controller, drive = grouped["/a/b/learning_controller"]
    assert "coarse/command" in alone["/electrodynamic_actuator"][0].subscribe - drive.subscribe
    assert "coarse/state" in alone["/learning_controller"][0].subscribe - controller.subscribe
    assert "coarse/state" in grouped["/a/b/tool"][0].subscribe


def test_a_stage_of_others_is_a_member_like_ours():
    """Without these topics it could not join the cell."""
    nodes = dict(scenario().nodes)
    ours = security.policy(scenarios.Scenario("ours", nodes))["/learning_controller"][0]
    nodes["learning_controller"] = TABLES["adrc"](stage="adrc")
    others = security.policy(scenarios.Scenario("others", nodes))["/learning_controller"][0]
    host = {topic.name for topic in HOST_TOPICS}
    assert ours.publish & host == others.publish & host == {"members", "progress", "/diagnostics"}
    assert ours.subscribe & host == others.subscribe & host == {"members", "cell_state"}


def test_an_encoder_device_may_read_what_comes_from_outside_of_the_cell():
    nodes = dict(scenario(encoder_device={"topic": "/lathe/joints", "revolutions": 1.0}).nodes)
    del nodes["spindle_encoder"]
    policy = security.policy(scenarios.Scenario("device", nodes))
    assert "/lathe/joints" in policy["/encoder_device"][0].subscribe
    assert not any("/lathe/joints" in profile.publish for enclave in policy.values() for profile in enclave)


def test_an_operator_may_call_but_not_publish():
    policy = security.policy(scenario(), beside=[security.OPERATOR])
    (operator,) = policy.pop("/operator")
    assert "learning_controller/schedule" in operator.request
    assert operator.publish == {"/rosout", "/parameter_events"}
    assert not any(profile.request for enclave in policy.values() for profile in enclave)


def test_an_attached_panel_asks_for_what_its_page_commands():
    watched = {"error_limit": 1e-3, "error_reaction": "warn"}
    held = scenario(spindle_encoder={"simulation_services": "playing"}, supervisor=watched)
    policy = security.policy(held, beside=[security.PANEL, RERUN_BRIDGE])
    listener, commands = policy["/panel"]
    assert listener.subscribe - policy["/rerun_bridge"][0].subscribe == {"safety"}
    asked = {f"{name}/schedule" for name in held.nodes} | {"spindle_encoder/set_parameters", "set_simulation_state"}
    assert commands.request == asked
    offered = frozenset().union(*(profile.reply for enclave in policy.values() for profile in enclave))
    assert asked <= offered


# ---- the real graph

#: the rule of a policy for each list of the graph
GRAPH = {"publisher": "publish", "subscriber": "subscribe", "service": "reply", "client": "request"}


def resolved(profile, name):
    """A name of a policy as SROS2 resolves it."""
    namespace = profile.get("ns").rstrip("/")
    if name.startswith("~"):
        return f"{namespace}/{profile.get('node')}{name[1:]}"
    return name if name.startswith("/") else f"{namespace}/{name}"


def allowed(root):
    """The permissions of a policy, by enclave, namespace and node; then by list of the graph."""
    return {
        (enclave.get("path"), profile.get("ns"), profile.get("node")): {
            kind: {resolved(profile, name.text) for rules in profile if rule in rules.attrib for name in rules}
            for kind, rule in GRAPH.items()
        }
        for enclave in root.iter("enclave")
        for profile in enclave.iter("profile")
    }


def shown(node, names):
    """The same as the ROS graph shows it; nodes that it does not know are left out."""
    enclaves = {(name, namespace): path for name, namespace, path in node.get_node_names_and_namespaces_with_enclaves()}
    found = {}
    for _, namespace, name in names:
        with contextlib.suppress(NodeNameNonExistentError):
            found[enclaves.get((name, namespace)), namespace, name] = {
                kind: {topic for topic, _ in getattr(node, f"get_{kind}_names_and_types_by_node")(name, namespace)}
                for kind in GRAPH
            }
    return found


def differences(a, b):
    """The difference of two, by node and list of the graph."""
    found = {}
    for node, kinds in a.items():
        for kind, names in kinds.items():
            if extra := names - b.get(node, {}).get(kind, set()):
                found[node, kind] = sorted(extra)
    return found


@pytest.fixture
def observer(domain):
    """A node that looks at the graph, and what spins it."""
    rclpy.init()
    node = rclpy.create_node("observer")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    yield node, executor
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()


def wait(observer, what):
    """Spin until ``what`` holds, or far too long; the caller checks the result."""
    with contextlib.suppress(AssertionError):
        until(what, lambda: observer[1].spin_once(timeout_sec=0.05))


def wait_for_block_0(observer, namespace="/"):
    """Wait until the spindle has found every member ready: then all that is theirs is there."""
    said = []
    topic = security.absolute(namespace, "cell_state")
    ear = observer[0].create_subscription(CellState, topic, lambda told: said.append(told.state), latched_qos(1))
    wait(observer, lambda: CellState.RUNNING in said)
    observer[0].destroy_subscription(ear)
    assert CellState.RUNNING in said


def compare(observer, root):
    """See that the graph shows what the policy allows, neither less nor more, in the right enclaves."""
    wanted = allowed(root)
    wait(observer, lambda: not differences(wanted, shown(observer[0], wanted)))
    found = shown(observer[0], wanted)
    assert differences(wanted, found) == {}, "allowed, but not used"
    assert differences(found, wanted) == {}, "used, but not allowed"


@contextlib.contextmanager
def running(folder, commands):
    """Processes with a log each in ``folder``; ended, whatever happens; one that goes on is killed and named."""
    environment = os.environ | {"ROS_LOG_DIR": str(folder)}
    started = []
    with contextlib.ExitStack() as stack:
        for number, command in enumerate(commands):
            ours, theirs = map(stack.enter_context, socket.socketpair())
            with theirs, (folder / f"{number}.log").open("ab") as log:
                child = process_launcher.server().start(
                    command,
                    environment=environment,
                    report=theirs,
                    log=log.fileno(),
                    command=[sys.executable, "-m", *command] if command[0].startswith("lathe_") else [],
                )
            started.append((child, folder / f"{number}.log", ours))
        try:
            yield
        finally:
            for child, _, _ in started:
                child.send_signal(signal.SIGTERM)
            for child, log, _ in started:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.wait(GRACE)
                if child.poll() is None:
                    child.send_signal(signal.SIGUSR1)
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        child.wait(1.0)
                    child.kill()
                    warnings.warn(f"did not end on SIGTERM: {log.read_text()[-2000:]}", stacklevel=1)


def members(loaded, root, folder):
    """Commands that start the cell of a policy: a process for each enclave."""
    complete = harness.with_recorder(loaded, folder / "bag", keep=True)
    file = folder / "scenario.yaml"
    file.write_text(complete.to_yaml(), encoding="utf-8")
    for enclave in root.iter("enclave"):
        nodes = [profile.get("node") for profile in enclave.iter("profile") if profile.get("node") in complete.nodes]
        if nodes:
            chosen = [f"{node}:{complete.kind(node)}" for node in nodes]
            yield [*chosen, *ros(enclave, "--params-file", str(file))]


def ros(enclave, *options):
    """ROS arguments of the process of an enclave."""
    namespace = next(enclave.iter("profile")).get("ns")
    return ["--ros-args", "-r", f"__ns:={namespace}", "--enclave", enclave.get("path"), *options]


ENDLESS = ["spindle_encoder.revolutions=0.0", "spindle_encoder.speed_factor=0.05"]


@pytest.mark.system
def test_a_namespaced_cell_in_groups_and_those_that_listen_to_it(observer, tmp_path):
    """A cell in groups and those that listen to it use what their policy allows, and nothing else."""
    rerun = [RERUN_BRIDGE] if importlib.util.find_spec("rerun") else []
    options = {
        TOPIC_RECORDER: ["-p", f"bag:={tmp_path / 'any'}"],
        MACHINE_STATE: [],
        RERUN_BRIDGE: ["-p", "output:=save", "-p", f"file:={tmp_path / 'live.rrd'}"],
    }
    words = ["--group", "learning_controller+electrodynamic_actuator", "--group", "spindle_encoder+tool"]
    words += ["--namespace", "/shop/left"]
    for kind in [TOPIC_RECORDER, MACHINE_STATE, *rerun]:
        words += ["--with", kind]
    root = parsed(made("piston", *words))
    commands = list(members(scenarios.load(CONFIG / "piston.yaml", ENDLESS), root, tmp_path))
    for enclave in list(root.iter("enclave"))[len(commands) :]:
        kind = next(enclave.iter("profile")).get("node")
        commands.append([STANDALONE[kind], *ros(enclave, *options[kind])])
    with running(tmp_path, commands):
        wait_for_block_0(observer, "/shop/left")
        compare(observer, root)


def test_the_replayer(observer, tmp_path):
    """The replayer uses what its policy allows, and nothing else."""
    pytest.importorskip("rosbag2_interfaces.srv")
    piston = scenarios.load(CONFIG / "piston.yaml", ["spindle_encoder.revolutions=1.0"])
    harness.run(piston, mode="composed", bag=tmp_path / "bag")
    root = parsed(made("piston", "--with", REPLAYER))
    (enclaves,) = root
    for enclave in list(enclaves):
        if enclave.get("path") != f"/{REPLAYER}":
            enclaves.remove(enclave)
    # With readers that never come, it stands at the first message.
    waiting = [STANDALONE[REPLAYER], *ros(enclaves[0], "-p", f"bag:={tmp_path / 'bag'}", "-p", "wait:=9")]
    with running(tmp_path, [waiting]):
        compare(observer, root)


@pytest.mark.system
def test_the_harness_names_the_enclaves(observer, domain, tmp_path):
    slow = scenario(spindle_encoder={"revolutions": 1000.0, "speed_factor": 1.0})  # that it is there to be looked at
    cell = harness.with_recorder(slow, tmp_path / "bag", keep=True)
    groups = cell.processes([["learning_controller", "electrodynamic_actuator"]])
    with harness.Processes(cell, groups, domain=domain):
        wanted = {(name, "/", f"/{group[0]}") for group in groups for name in group}
        wait(observer, lambda: wanted <= set(observer[0].get_node_names_and_namespaces_with_enclaves()))
        assert wanted <= set(observer[0].get_node_names_and_namespaces_with_enclaves())


# ---- discovery stays on this machine


def udp_ports(pid):
    """UDP ports on which a process listens."""
    links = [str(file.readlink()) for file in Path(f"/proc/{pid}/fd").iterdir() if file.is_symlink()]
    inodes = {link.removeprefix("socket:[").removesuffix("]") for link in links}
    rows = [line.split() for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]]
    return {int(row[1].partition(":")[2], 16) for row in rows if row[9] in inodes}


def as_started_by_a_user(monkeypatch):
    """Settings of the nodes in this process hold for those that it starts, too."""
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTDDS_BUILTIN_TRANSPORTS", "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize("wanted", [None, "SUBNET"])
def test_processes_of_the_harness_hear_the_network_only_if_asked_to(wanted, tmp_path, monkeypatch):
    as_started_by_a_user(monkeypatch)
    if wanted:
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", wanted)
    cell = harness.with_recorder(scenario(), tmp_path / "bag", keep=True)
    with harness.Processes(cell, [list(cell.nodes)]) as processes:
        processes.wait_for("ready")
        assert (multicast(processes.domain) in udp_ports(processes.pids["tool"])) == (wanted is not None)


def multicast(domain):
    """The UDP port of a ROS domain on which its participants look for each other, as the DDS standard has it."""
    return 7400 + 250 * domain


@pytest.mark.parametrize("wanted", [None, pytest.param("SUBNET", marks=pytest.mark.system)])
def test_a_node_alone_hears_the_network_only_if_asked_to(wanted, observer, domain, tmp_path, monkeypatch):
    as_started_by_a_user(monkeypatch)
    if wanted:
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", wanted)
    with subprocess.Popen([sys.executable, "-m", "lathe_rc.nodes.executables", "tool", "--ros-args"]) as process:
        try:
            wait(observer, lambda: "tool" in observer[0].get_node_names())
            assert (multicast(domain) in udp_ports(process.pid)) == (wanted is not None)
        finally:
            process.terminate()
