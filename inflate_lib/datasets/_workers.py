"""Who simulates: processes of this machine (joblib), or an existing Dask cluster, each task counted once.

To a cluster the tasks go out as Dask futures and not through joblib's Dask backend, which keeps the arguments of a task
on one worker only, where they are lost with it, and which cannot hand over results as they come.
"""

from itertools import islice

from joblib import Parallel, delayed, effective_n_jobs
from joblib.parallel import BACKENDS, EXTERNAL_BACKENDS, get_active_backend

from inflate_lib._cache import step_version

IN_FLIGHT = 4  # tasks per thread of the cluster that wait or run at a time
SCHEMES = ("tcp", "tls", "ws", "wss", "ucx", "inproc")
PATIENCE = 30  # seconds to wait for the scheduler, and for the first worker


def run_on_cluster(address, function, tasks):
    """Call a function of this package on the workers of a Dask cluster.

    Parameters
    ----------
    address : str
        Of the scheduler, ``tcp://host:8786``. The workers need this version of ``inflate_lib``.
    function : callable
        Without side effects: where a worker dies, Dask runs its tasks again elsewhere.
    tasks : iterable of tuple
        Arguments of each call; read as they are needed.

    Yields
    ------
    (int, object)
        Number of the task and its result, in the order in which they finish, each exactly once.

    Raises
    ------
    RuntimeError
        Where distributed is not installed, no scheduler or no worker answers, a worker has other code, or Dask gave a
        task up (after it killed several workers).
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise RuntimeError("Dask is not installed here: pip install 'inflate-lib[dask]'") from None
    scheme, _, place = address.partition("://")
    if scheme not in SCHEMES or not place:
        raise RuntimeError(f"{address} is no address of a Dask scheduler; one looks like tcp://host:8786")
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise RuntimeError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise RuntimeError(f"the Dask cluster at {address} has no workers") from None
        code, numbers, waiting = step_version("dataset"), {}, enumerate(tasks)
        threads = sum(client.ncores().values())

        def submit(count):
            futures = []
            for number, task in islice(waiting, count):
                futures.append(client.submit(_checked, code, function, task, pure=False))
                numbers[futures[-1].key] = number
            return futures

        finished = as_completed(submit(IN_FLIGHT * threads), loop=client.loop)
        for future in finished:
            try:
                result = future.result()
            except Exception as error:  # whatever went wrong over there
                raise RuntimeError(f"the Dask cluster at {address} failed: {error or type(error).__name__}") from error
            finished.update(submit(1))
            yield numbers.pop(future.key), result


def current_address():
    """Address of the scheduler of this process's ``distributed.Client``; a ValueError where there is none."""
    try:
        from distributed import get_client

        return get_client().scheduler.address
    except (ImportError, ValueError):
        raise ValueError(
            "backend 'dask' needs a distributed.Client in this process; or give the address of a scheduler, "
            "tcp://host:8786"
        ) from None


def _checked(code, function, task):
    """Runs on a worker: the call, unless this worker has other code than the one who asks."""
    if step_version("dataset") != code:
        raise RuntimeError("a worker has another version of inflate_lib than this machine")
    return function(*task)


def check_backend(backend):
    """The address of the Dask scheduler that `backend` means, or None where joblib does the work."""
    known = sorted({*BACKENDS, *EXTERNAL_BACKENDS})
    if backend is None:
        active, _ = get_active_backend()
        return active.client.scheduler.address if isinstance(active, BACKENDS.get("dask", ())) else None
    if isinstance(backend, str):
        if "://" in backend:
            return backend
        if backend == "dask":
            return current_address()
        if backend in known:
            return None
    raise ValueError(
        f"unknown backend {backend!r}; choose one of {', '.join(known)}, or give the address of a Dask scheduler, "
        "tcp://host:8786"
    )


def run_here(function, tasks, n_jobs, backend):
    """Number of each task and its result, in the order in which joblib finishes them."""
    calls = (delayed(_numbered)(number, function, task) for number, task in enumerate(tasks))
    options = {"n_jobs": n_jobs, "backend": backend, "batch_size": 1}
    try:
        parallel = Parallel(**options, return_as="generator_unordered")
    except ValueError:  # "multiprocessing" hands over results at the end only: have many ends
        with Parallel(**options) as parallel:
            while some := list(islice(calls, 4 * effective_n_jobs(n_jobs))):
                yield from parallel(some)
    else:
        yield from parallel(calls)


def _numbered(number, function, task):
    return number, function(*task)
