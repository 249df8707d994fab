"""Settings of the C library's allocator for large blocks, such as batches of images and activations."""

import ctypes
import os
import sys

# Parameters of mallopt (glibc's malloc.h), and the largest threshold that it accepts.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST_THRESHOLD = 32 * 1024 * 1024


def tune_allocator() -> bool:
    """Keep freed blocks of up to 32 MiB in the process instead of returning each to the system.

    By default glibc maps every large block anew and unmaps it when it is freed, so that each batch of images and each
    layer's activations cost page faults. The process's memory then stays at its peak. Each model calls it; with
    ``MALLOC_MMAP_THRESHOLD_`` or ``MALLOC_TRIM_THRESHOLD_`` in the environment it changes nothing.

    :return: Whether it worked; it does nothing where the C library is not glibc
    """
    chosen = {"MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"} & os.environ.keys()
    if chosen or not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST_THRESHOLD)) and bool(mallopt(_M_TRIM_THRESHOLD, 2**31 - 1))
