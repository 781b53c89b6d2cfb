# SPDX-License-Identifier: Apache-2.0
"""Settings that all tests share."""

import faulthandler
import gc
import signal
import sys
from collections import Counter

import pytest
import rclpy
from _pytest.faulthandler import fault_handler_stderr_fd_key
from hypothesis import HealthCheck, settings

import slow_tests
from lathe_rc import allowed_code, harness, process_launcher
from lathe_rc.nodes import dds

# Jsonschema, which Altair imports, would compile a grammar with it for 2 s in each worker.
sys.modules["rfc3987_syntax"] = None

# The same examples on every machine; --hypothesis-profile=explore looks for new ones.
settings.register_profile(
    "steady", derandomize=True, deadline=None, max_examples=25, database=None,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
settings.register_profile("explore", settings.get_profile("steady"), derandomize=False, max_examples=1000)
settings.load_profile("steady")

# A shell without job control makes what it starts in the background ignore it, and so would the commands under test.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Nodes that the tests make have the DDS settings of those of a cell: by default what one missed comes after 3 s.
dds.settle()


_started = Counter()  # processes that the running test has started, by their kind


def _count_program(event, arguments):
    if event == "subprocess.Popen" and not any("lathe_rc.nodes.fork_server" in str(word) for word in arguments[1]):
        _started["programs"] += 1


def _counted(start):
    def call(*arguments, **options):
        _started["processes"] += 1
        return start(*arguments, **options)

    return call


sys.addaudithook(_count_program)
process_launcher.ForkServer.start = _counted(process_launcher.ForkServer.start)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item, call):
    """Report the processes of cells and the programs that a test has started; fixtures count for their first test."""
    if call.when == "teardown":
        item.user_properties.extend(_started.items())
        _started.clear()


def _bounded(item):
    """End a worker that hangs beyond the timeout of its test, where no signal gets through or in what cleans up."""
    marked = item.get_closest_marker("timeout")
    seconds = float(marked.args[0] if marked else item.config.getini("timeout"))
    faulthandler.dump_traceback_later(seconds + 120.0, file=item.config.stash[fault_handler_stderr_fd_key], exit=True)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


# Again before the clean-up: pytest cancels it when a test fails.
pytest_runtest_protocol = pytest_runtest_teardown = pytest.hookimpl(wrapper=True)(_bounded)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """The collected tests stay to the end: freeze them, so that the garbage collector skips them."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


#: files of system tests that take a minute or more; docs/tests.md has the others' shares
LONGEST = (
    "test_wheel",
    "test_simulation_services",
    "test_schedules",
    "test_c_libraries",
    "test_c_coverage",
    "test_panel_browser",
)

_ended_a_worker = []  # tests; the worker in its place would run them again


def pytest_handlecrashitem(crashitem):
    _ended_a_worker.append(crashitem)


def pytest_configure_node(node):
    node.workerinput["skipped"] = list(_ended_a_worker)


def pytest_collection_modifyitems(config, items):
    """On a worker, files that take long come first: else one of them would be the last, with nothing beside it."""
    if hasattr(config, "workerinput"):
        shares = slow_tests.shares()
        items.sort(key=lambda item: (item.path.stem not in LONGEST, -shares.get(item.path.stem, 0.0)))
        for item in items:
            if item.nodeid in config.workerinput["skipped"]:
                item.add_marker(pytest.mark.skip("it has ended a worker"))


@pytest.fixture(autouse=True, scope="module")
def program():
    """Each module is a program of its own, which allows code for itself."""
    with allowed_code.call(own=True):
        yield


@pytest.fixture(scope="module")
def client():
    """A client of Dask whose worker is a thread of this process: to start others takes seconds."""
    import distributed

    options = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.Client(**options, set_as_default=False) as client:
        yield client


@pytest.fixture
def no_pictures(monkeypatch):
    """Pages without pictures for paper and without Vega, where a test reads the rest of them: those take seconds."""
    from lathe_rc.drawing import charts

    monkeypatch.setattr(charts, "library", str)
    monkeypatch.setattr(charts.Charts, "png", lambda *_: b"")
    monkeypatch.setattr(charts.Charts, "picture", lambda *_: "")


@pytest.fixture
def domain(monkeypatch):
    """A ROS domain of its own, for this process and those that it starts."""
    with harness.free_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield number


@pytest.fixture
def ghost(domain):
    """A node that belongs to no cell."""
    rclpy.init()
    node = rclpy.create_node("ghost", namespace="/haunted")
    yield node
    # What is latched would haunt the next test in the same domain.
    node.destroy_node()
    rclpy.shutdown()
