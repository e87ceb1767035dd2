import threading

import pytest
import scipy.linalg  # noqa: F401  # brings a BLAS
from threadpoolctl import threadpool_info, threadpool_limits

from autoreg.blas_threads import one_blas_thread


def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        if threads() != {2}:
            pytest.skip("this BLAS has one thread at most")
        yield


def test_blas_is_held_to_one_thread_and_given_back():
    with one_blas_thread():
        assert threads() == {1}
        with one_blas_thread():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == {2}


def test_it_is_given_back_when_something_fails():
    with pytest.raises(KeyError), one_blas_thread():
        raise KeyError
    assert threads() == {2}


def test_whoever_leaves_last_gives_it_back():
    entered, leave = threading.Event(), threading.Event()

    def other():
        with one_blas_thread():
            entered.set()
            leave.wait(30)

    thread = threading.Thread(target=other)
    with one_blas_thread():
        thread.start()
        assert entered.wait(30)
    # The one who came first and knows the process's own number has gone.
    assert threads() == {1}
    leave.set()
    thread.join()
    assert threads() == {2}
