"""Training in its own thread: results and errors come back to whoever waits."""

from __future__ import annotations

import threading

import pytest

from meslam_core.mapping.joint_optimizer import StepLosses
from meslam_core.mapping.training_worker import Training, TrainingWorker

WAIT_S = 10.0


@pytest.fixture
def worker():
    worker = TrainingWorker()
    yield worker
    worker.close()


def test_a_job_runs_beside_its_caller(worker):
    begun, go_on = threading.Event(), threading.Event()
    threads = []

    def job() -> Training:
        threads.append(threading.current_thread())
        begun.set()
        assert go_on.wait(WAIT_S)
        return Training()

    worker.start(job)
    # The caller gets here while the job still runs.
    assert begun.wait(WAIT_S)
    go_on.set()
    worker.wait()
    assert threads[0] is not threading.current_thread()
    assert threads[0].name.startswith("meslam-mapping")


def test_a_result_is_given_once(worker):
    assert worker.wait() is None
    training = Training(StepLosses(1.0, 2.0, 3.0, 4), 5.0)
    worker.start(lambda: training)
    assert worker.wait() is training
    assert worker.wait() is None


def test_one_job_follows_another_in_the_same_thread(worker):
    threads = set()

    def job() -> Training:
        threads.add(threading.current_thread())
        return Training(duration_ms=float(len(threads)))

    for _ in range(3):
        worker.start(job)
        assert worker.wait() == Training(duration_ms=1.0)
    assert len(threads) == 1


def test_an_error_is_raised_by_wait_and_the_worker_goes_on(worker):
    def fail() -> Training:
        raise ValueError("no rays")

    worker.start(fail)
    with pytest.raises(ValueError, match="no rays"):
        worker.wait()
    assert worker.wait() is None
    worker.start(Training)
    assert worker.wait() == Training()


def test_closing_waits_for_the_job_and_ends_the_thread():
    worker = TrainingWorker()
    go_on = threading.Event()
    threads, done = [], []

    def job() -> Training:
        threads.append(threading.current_thread())
        assert go_on.wait(WAIT_S)
        done.append(True)
        return Training()

    worker.start(job)
    threading.Timer(0.02, go_on.set).start()
    worker.close()
    assert done
    assert not threads[0].is_alive()


def test_who_waits_for_the_end_leaves_the_result_to_others(worker):
    worker.settle()
    training = Training(StepLosses(1.0, 2.0, 3.0, 4), 5.0)
    ended = threading.Event()

    def job() -> Training:
        ended.set()
        return training

    worker.start(job)
    worker.settle()
    assert ended.is_set()
    assert worker.wait() is training
