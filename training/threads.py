"""CPU threads of torch, as every command sets them."""

import os


def use_threads(count: int, where: str = "--threads") -> None:
    """Let torch use ``count`` threads; ValueError, which names ``where`` the number stands, beyond
    1 to four times the number of CPUs (many thousands end the process)."""
    most = 4 * (os.cpu_count() or 1)
    if not 1 <= count <= most:
        raise ValueError(f"{where} {count} is not allowed: 1 to {most} on this machine")
    # MKL's products of matrices would else depend, in their last digits, on where in memory they
    # lie, and so would weights. It must be set before MKL is first used.
    os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
    import torch

    torch.set_num_threads(count)
