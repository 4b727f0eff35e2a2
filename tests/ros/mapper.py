"""The node under test as a process, and a ROS 2 node that looks at it from outside."""

import os
import pathlib
import signal
import subprocess
import threading
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor

ROOT = pathlib.Path(__file__).resolve().parents[2]


class Checks:
    """Says each thing that was looked at, and counts what failed."""

    def __init__(self):
        self.n_failed = 0
        self.n = 0

    def __call__(self, name, is_good, detail=""):
        self.n += 1
        self.n_failed += not is_good
        detail = f": {detail}" if detail != "" else ""
        print(f"{'ok    ' if is_good else 'FAILED'}  {name}{detail}", flush=True)
        return is_good


class Mapper:
    """`splat-mapper` with arguments; its log is kept."""

    def __init__(self, *arguments, log="mapper.log"):
        program = os.environ["SPLAT_MAPPER"]
        self.log_path = pathlib.Path(os.environ.get("ROS_TEST_OUT", "/tmp")) / log
        self.log_file = open(self.log_path, "w")
        self.process = subprocess.Popen(
            [program, *arguments], stdout=self.log_file, stderr=subprocess.STDOUT, cwd=ROOT
        )

    def log(self):
        return self.log_path.read_text(errors="replace")

    def wait_for_log(self, text, secs=20.0):
        return wait_until(lambda: text in self.log(), secs)

    def end(self, secs=30.0):
        """SIGINT; (exit code, seconds), killed when it takes too long."""
        begin = time.monotonic()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            code = self.process.wait(secs)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        self.log_file.close()
        return code, time.monotonic() - begin


def wait_until(condition, secs):
    """Looks often; true as soon as the condition is."""
    end = time.monotonic() + secs
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return condition()


class Observer:
    """A node that spins on a thread and keeps what it receives."""

    def __init__(self, name="observer"):
        self.node = rclpy.create_node(name)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.received = {}
        self.is_ending = False
        self.thread = threading.Thread(target=self.spin, daemon=True)
        self.thread.start()

    def spin(self):
        while not self.is_ending and rclpy.ok():
            self.executor.spin_once(timeout_sec=0.05)

    def listen(self, kind, topic, qos=10):
        """A list that grows with (monotonic seconds, message)."""
        messages = self.received.setdefault(topic, [])
        self.node.create_subscription(kind, topic, lambda m: messages.append((time.monotonic(), m)), qos)
        return messages

    def call(self, kind, name, request, secs=40.0):
        """The response, or None."""
        client = self.node.create_client(kind, name)
        try:
            if not client.wait_for_service(timeout_sec=10.0):
                return None
            future = client.call_async(request)
            wait_until(future.done, secs)
            return future.result() if future.done() else None
        finally:
            self.node.destroy_client(client)

    def close(self):
        self.is_ending = True
        self.thread.join()
        self.node.destroy_node()
