"""Devices that commands may be asked for."""

import time

import torch


def checked_device(name: str) -> torch.device:
    """The device of a name. ValueError, in one line that says what is available, for one that is
    not there."""
    cards = torch.cuda.device_count() if torch.cuda.is_available() else 0
    known = ["cpu", *(["cuda"] if cards else []), *(f"cuda:{i}" for i in range(cards))]
    if name not in known:
        how = "" if cards else "; for a GPU, install torch built for it (pytorch.org/get-started)"
        raise ValueError(f"--device {name} is not there: {', '.join(known)} available{how}")
    return torch.device(name)


def clock(device: torch.device) -> float:
    """Seconds of a clock, once the device has done all that it was given."""
    if device.type == "cuda" and torch.cuda.is_available():
        torch.cuda.synchronize(device)
    return time.perf_counter()
