"""A Dask cluster gives the bytes of a run alone, whatever becomes of its workers; what goes wrong is one line."""

import logging
import os
import signal
import threading
import time

import numpy as np
import pytest

from strandscope.core import cluster as clusters
from strandscope.core.cli import run
from strandscope.core.cluster import Cluster, Hands
from strandscope.core.crew import Threads
from strandscope.core.errors import StrandscopeError
from strandscope.core.features import USED, build_index, load_features, save_features
from strandscope.core.pipeline import reconstruct
from strandscope.core.simulate import SimulateParams, simulate

from .conftest import CAPTURED_ONLY
from .known import OPTICS, line, observe

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore")  # of Dask's own


@pytest.fixture(scope="module")
def pair():
    """A cluster of two worker processes."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=logging.CRITICAL) as made:
        yield made


def workers_of(made) -> dict[str, int]:
    """Process of each worker."""
    with distributed.Client(made.scheduler_address, set_as_default=False) as client:
        return client.run(os.getpid)


def test_photographs_and_growing_give_the_bytes_of_a_run_alone(pair, tmp_path):
    simulate(tmp_path / "lock", SimulateParams(scale="tiny", fibers=2))
    reconstruct(tmp_path / "lock", tmp_path / "alone.npz", CAPTURED_ONLY, workers=2)
    reconstruct(tmp_path / "lock", tmp_path / "s.npz", CAPTURED_ONLY, scheduler=pair.scheduler_address)
    assert (tmp_path / "s.npz").read_bytes() == (tmp_path / "alone.npz").read_bytes()
    one, other = ({p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} for name in ("s.work", "alone.work"))
    assert one == other


@pytest.mark.parametrize("share", [0.1, 0.6])
def test_a_worker_that_is_killed_changes_nothing(pair, lock, tmp_path, share):
    victims = list(workers_of(pair).values())[:1]

    def kill(stage, done, total):
        if victims and stage == "growing" and done >= share * total:
            os.kill(victims.pop(), signal.SIGKILL)

    reconstruct(lock[0], tmp_path / "s.npz", CAPTURED_ONLY, progress=kill, scheduler=pair.scheduler_address)
    assert not victims
    assert (tmp_path / "s.npz").read_bytes() == lock[1]
    assert [path.name for path in tmp_path.iterdir()] == ["s.npz"]


def test_a_run_that_is_cut_short_there_goes_on_here(pair, lock, tmp_path):
    def cut(stage, done, total):
        if stage == "growing" and done >= 0.5 * total:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(lock[0], tmp_path / "s.npz", CAPTURED_ONLY, progress=cut, scheduler=pair.scheduler_address)
    assert [path.name for path in (tmp_path / "s.work").iterdir()] == ["growing.journal"]
    reconstruct(lock[0], tmp_path / "s.npz", CAPTURED_ONLY)
    assert (tmp_path / "s.npz").read_bytes() == lock[1]


def test_workers_know_what_is_used_up(pair, tmp_path):
    """Whatever is used up and set free again, and with whatever maps between."""
    sweeps = observe([line()])
    for i, sweep in enumerate(sweeps):
        save_features(tmp_path / f"{i}.features", sweep)
    rng, index = np.random.default_rng(0), build_index(sweeps, OPTICS)
    files = [tmp_path / f"{i}.features" for i in range(len(sweeps))]
    with Cluster(pair.scheduler_address, [tmp_path]) as cluster, Hands(cluster, index, 1, files, OPTICS, tmp_path / "used") as hands:
        for step in range(20):
            if step % 6 == 3:
                hands.free()
            for _ in range(step % 4):
                hands.use(rng.integers(len(index.strength), size=50).astype(np.int32))
            if step % 3 != 1:
                told = hands.each(getattr, ["strength"] * 5)
                assert all(np.array_equal(strength, index.strength) for strength in told)
    assert np.any(index.strength >= USED)
    assert not (tmp_path / "used").exists()


def test_maps_are_in_order_on_a_cluster_and_on_threads(pair, tmp_path):
    with Cluster(pair.scheduler_address, [tmp_path]) as cluster:
        assert list(cluster.map(abs, range(-20, 0))) == [*range(20, 0, -1)]
        assert list(cluster.map(abs, [])) == []
    with Threads(None, 2) as crew:
        assert crew.here(abs, range(-20, 0)) == [*range(20, 0, -1)]


def test_an_error_in_a_worker_is_the_error_of_the_run(pair, tmp_path):
    with Cluster(pair.scheduler_address, [tmp_path]) as cluster, pytest.raises(StrandscopeError, match="a: not a whole features file"):
        list(cluster.map(load_features, [tmp_path / "a"] * 5))


def test_a_worker_that_does_not_see_the_capture_is_named(pair, tmp_path):
    with (
        Cluster(pair.scheduler_address, [tmp_path / "elsewhere"]) as cluster,
        pytest.raises(StrandscopeError, match=r"elsewhere: worker tcp://\S+ does not see it"),
    ):
        list(cluster.map(abs, range(5)))


def test_a_worker_with_other_packages_is_named(pair, tmp_path, monkeypatch):
    monkeypatch.setattr(clusters, "versions", lambda: {"Python": "3.13", "numpy": "1.0", "numba": "0", "scipy": "0"})
    with Cluster(pair.scheduler_address, [tmp_path]) as cluster, pytest.raises(StrandscopeError, match=r"tcp://\S+: has \w+ \S+; expected"):
        list(cluster.map(abs, range(5)))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "tcp://", "tls://127.0.0.1:9"])
def test_where_no_scheduler_answers_that_is_said(lock, tmp_path, capsys, monkeypatch, address):
    monkeypatch.setattr(clusters, "CONNECT_S", 0.5)
    assert run(["reconstruct", str(lock[0]), "-o", str(tmp_path / "s.npz"), "--scheduler", address, "--progress", "none"]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"strandscope: {address}: ")
    assert "expected" in err
    assert len(err.splitlines()) == 1


def test_without_a_worker_it_waits_says_so_and_goes_on(tmp_path, monkeypatch):
    for name, seconds in (("LOOK_S", 0.1), ("TELL_S", 0.3)):
        monkeypatch.setattr(clusters, name, seconds)
    said = []
    with distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None, silence_logs=logging.CRITICAL) as made:
        timer = threading.Timer(1.5, made.scale, [1])
        timer.start()
        with Cluster(made.scheduler_address, [tmp_path], said.append) as cluster:
            assert list(cluster.map(abs, [-1, -2])) == [1, 2]
        timer.join()
    assert len(said) == 2
    assert "there is no worker" in said[0]
    assert "goes on" in said[1]


def test_without_a_worker_it_ends_at_last(tmp_path, monkeypatch):
    for name, seconds in (("LOOK_S", 0.1), ("TELL_S", 0.1), ("WAIT_S", 0.5)):
        monkeypatch.setattr(clusters, name, seconds)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None, silence_logs=logging.CRITICAL) as made,
        Cluster(made.scheduler_address, [tmp_path]) as cluster,
        pytest.raises(StrandscopeError, match="no worker for"),
    ):
        list(cluster.map(abs, [-1]))


def test_a_scheduler_that_ends_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(clusters, "LOOK_S", 0.2)
    made = distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=logging.CRITICAL)
    with Cluster(made.scheduler_address, [tmp_path]) as cluster:
        results = cluster.map(time.sleep, [0.1] * 100)
        next(results)
        made.close()
        with pytest.raises(StrandscopeError, match="the scheduler does not answer any more"):
            list(results)
