"""A GPU where there is none: tensors that say they are on "cuda", and are computed on the CPU.

Unlike FakeTensorMode's they have values, so that code whose shapes depend on numbers runs, and
results can be compared with the CPU's. Whatever a real card refuses is an error: an operation on
tensors of two devices (a single number aside), ``.numpy()`` of a tensor on the card. What is read
back from the card is counted.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

CARD = torch.device("cuda:0")
_BELOW = torch.device("meta")  # what C++ is given: this device needs no driver
_READS = ("_local_scalar_dense", "nonzero", "equal", "is_nonzero")  # a number comes back
_MOVES = ("_to_copy", "copy_")  # take tensors of two devices


class OnCard(Tensor):
    """A tensor whose numbers are those of ``inner``, on the CPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "OnCard":
        made = Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=_BELOW,
        )
        made.inner = inner.detach()
        return made

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return CARD

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(
        cls, function: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        return run(function, args, kwargs or {}, Counter())

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"OnCard({self.inner})"


def run(function: Any, args: Sequence[Any], kwargs: dict[str, Any], reads: Counter[str]) -> Any:
    """An operation on tensors of the card, or one that makes some."""
    name = function.overloadpacket.__name__
    flat, _ = tree_flatten((args, kwargs))
    tensors = [one for one in flat if isinstance(one, Tensor)]
    on_card = [one for one in tensors if isinstance(one, OnCard)]
    wanted = kwargs.get("device")
    to_card = bool(on_card) if wanted is None else _is_card(wanted)
    if on_card and name not in _MOVES:
        strangers = [
            one
            for one in tensors
            if not isinstance(one, OnCard) and one.dim() and "index" not in name
        ]
        if strangers:
            shapes = ", ".join(f"{list(one.shape)} on {one.device}" for one in tensors)
            raise RuntimeError(f"{name}: tensors of two devices: {shapes}")
    reads_back = name in _READS or any(
        isinstance(one, OnCard) and one.dtype == torch.bool
        for one in (tree_flatten(args[1])[0] if name.startswith("index") and len(args) > 1 else ())
    )
    if on_card and (reads_back or (name == "_to_copy" and not to_card)):
        reads[name] += 1
    if name == "copy_":
        to_card = isinstance(args[0], OnCard)
        if not to_card and isinstance(args[1], OnCard):
            reads[name] += 1
    known = {id(one.inner): one for one in on_card}

    def out(one: Any) -> Any:
        if not isinstance(one, Tensor) or not to_card:
            return one
        return known[id(one)] if id(one) in known else OnCard(one)

    if wanted is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    plain, named = tree_map(_inner, (tuple(args), kwargs))
    found = function(*plain, **named)
    if name == "_to_copy" and to_card and any(found is one.inner for one in on_card):
        found = found.clone()
    return tree_map(out, found)


def _is_card(device: Any) -> bool:
    return torch.device(device).type in (CARD.type, _BELOW.type)


def _inner(one: Any) -> Any:
    return one.inner if isinstance(one, OnCard) else one


class _Operations(TorchDispatchMode):
    """Every operation, those that C++ starts itself included."""

    def __init__(self, reads: Counter[str]) -> None:
        super().__init__()
        self.reads = reads

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        wanted = kwargs.get("device")
        flat, _ = tree_flatten((args, kwargs))
        card = wanted is not None and _is_card(wanted)
        if card or any(isinstance(one, OnCard) for one in flat):
            return run(function, args, kwargs, self.reads)
        return function(*args, **kwargs)


class _Calls(TorchFunctionMode):
    """Calls that would look for a card before any operation starts."""

    def __torch_function__(
        self, function: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if function is Tensor.numpy and isinstance(args[0], OnCard):
            raise TypeError("numpy() of a tensor on the card: .cpu() first")
        if function is Tensor.new_tensor and isinstance(args[0], OnCard):
            return OnCard(args[0].inner.new_tensor(*args[1:], **kwargs))
        if function in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], OnCard):
            args = (args[0], _without_lists(args[1]), *(_on_card(one, args[0]) for one in args[2:]))
        if function is Tensor.tolist and isinstance(args[0], OnCard):
            return args[0].to("cpu").tolist()
        if function is Tensor.cpu:
            return args[0].to("cpu")
        wanted = kwargs.get("device")
        if wanted is not None and _is_card(wanted):
            if function in (torch.tensor, torch.as_tensor):
                made = function(*args, **kwargs | {"device": "cpu"})
                return made if isinstance(made, OnCard) else OnCard(made)
            if not any(isinstance(one, Tensor) for one in tree_flatten((args, kwargs))[0]):
                return OnCard(function(*args, **kwargs | {"device": "cpu"}))
        if function is Tensor.to and isinstance(args[0], Tensor):
            return _moved(function, args, kwargs)
        return function(*args, **kwargs)


def _without_lists(index: Any) -> Any:
    """An index whose sequences are tensors, which C++ would lose below."""
    if not isinstance(index, tuple):
        index = (index,)
    return tuple(
        torch.tensor(one, dtype=None if one else torch.int64)
        if isinstance(one, list | tuple)
        else one
        for one in index
    )


def _on_card(value: Any, like: OnCard) -> Any:
    """A number that is assigned, as a tensor, which C++ would lose below."""
    return value if isinstance(value, Tensor) else OnCard(torch.tensor(value, dtype=like.dtype))


def _moved(function: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """``tensor.to(…)`` of a device, a type, both, or another tensor."""
    tensor, *rest = args
    device = kwargs.pop("device", None)
    left = []
    for one in rest:
        if isinstance(one, Tensor):
            device = one.device
            left.append(one.dtype)
        elif isinstance(one, torch.device | str):
            device = torch.device(one)
        elif isinstance(one, torch.dtype):
            left.append(one)
    if device is not None and _is_card(device):
        if not isinstance(tensor, OnCard):
            tensor = OnCard(tensor.detach().clone())
    elif device is not None and isinstance(tensor, OnCard):
        tensor = torch.ops.aten._to_copy(tensor, device=torch.device("cpu"))
    return function(tensor, *left, **kwargs) if left or kwargs else tensor


@contextmanager
def card() -> Iterator[Counter[str]]:
    """Inside, "cuda" is a device; what is read back from it is counted, by operation."""
    reads: Counter[str] = Counter()
    with ExitStack() as stack:
        for name, value in (("current_device", 0), ("synchronize", None)):
            stack.enter_context(patch.object(torch.cuda, name, lambda *_, value=value: value))
        stack.enter_context(_Operations(reads))
        stack.enter_context(_Calls())
        yield reads
