"""CPU cores that this process may use, and the threads of its workers.

- A process of matching has all cores, or PyTorch's own number if that is less (``OMP_NUM_THREADS``), divided by
  the number of these processes: for PyTorch and OpenCV (:func:`limit_matching_threads`). There is one for each
  device, unless ``--workers`` has another number.
- A Ray actor has as many as one process alone on its machine; without GPUs, the CPUs that Ray has there.
- A process of estimates has one thread, in all libraries (:func:`limit_to_one_thread`).
- A process of a scene limits no library. It verifies pairs on all cores. Its mapper has ``threads`` of
  [scene], one by default, and its last adjustment one.
- A thread of the user's process (``--workers 0``) leaves the limits of the process as they are.

The number of processes is decided in :mod:`mkpc_kaggle.engine.places`.
"""

import os

# For PyTorch, which reads these once. OpenMP threads that wait for each other then sleep; by default they spin
# and keep the cores from decoding, MAGSAC and other processes. On Linux, tensors of 2 MiB or more use huge pages:
# with small pages, allocating a feature map takes as long as some convolutions.
WORKER_ENVIRONMENT = {
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "0",
    "THP_MEM_ALLOC_ENABLE": "1",
}


def available_cores() -> int:
    """Return the number of cores that this process may use, by its affinity and its container's quota."""
    import joblib  # here, since the import takes a while

    return int(joblib.cpu_count())


def limit_matching_threads(threads: int = 0, share: int = 1) -> None:
    """Limit PyTorch and OpenCV to ``threads``, or to the cores of one of ``share`` processes."""
    import cv2
    import torch

    # PyTorch counts the machine's cores, and knows OMP_NUM_THREADS.
    available = min(torch.get_num_threads(), available_cores())
    threads = threads or max(1, available // share)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def limit_to_one_thread() -> None:
    """Limit OpenCV, the libraries of NumPy and SciPy, and PyTorch to one thread."""
    import cv2
    from threadpoolctl import threadpool_limits

    # For libraries that a job may load later: PyTorch
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    cv2.setNumThreads(1)
    threadpool_limits(1)
