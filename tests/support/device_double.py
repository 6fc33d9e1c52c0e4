"""A simulated GPU: tensors say ``cuda:N`` and are computed on the CPU; devices that meet raise, as
on a GPU.

    with DeviceDouble(count=2):
        network.to("cuda:1")(image.to("cuda:1"))

It works with a CPU build of PyTorch. To PyTorch's own code a tagged tensor lies on ``meta:N``, for
which every build has a guard; all that Python can ask it says ``cuda:N``, and all operators come to
:meth:`DeviceDouble.run`.

These raise :class:`MixedDevicesError`: an operator on tensors of two devices, but for a CPU tensor of no
dimensions and for CPU indices into a tagged tensor, which a GPU takes as well; a generator of another device.
``.numpy()`` of a tagged tensor is the TypeError that it is on a GPU. It cannot show a GPU's rounding, its
memory, its speed, half precision.

Enter it in the thread that computes; networks that were moved within it are of no use outside of
it.
"""

from __future__ import annotations

from contextlib import ExitStack
from unittest.mock import patch

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"}


class MixedDevicesError(RuntimeError):
    """Tensors, or a tensor and a generator, of different devices met in an operator."""


class Tagged(torch.Tensor):
    """A tensor that says it is on a GPU; ``held`` is the CPU tensor with its values."""

    held: torch.Tensor
    place: torch.device

    @staticmethod
    def __new__(cls, held, where):
        device = torch.device("meta", where.index)
        layout = {
            "strides": held.stride(),
            "storage_offset": held.storage_offset(),
            "dtype": held.dtype,
        }
        made = torch.Tensor._make_wrapper_subclass(cls, held.shape, **layout, device=device)
        made.held = held
        made.place = where
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: self.place)
    is_cuda = property(lambda self: True)
    is_cpu = is_meta = property(lambda self: False)

    def numpy(self, *, force=False):
        if force:
            return self.held.numpy(force=True)
        raise TypeError(f"can't convert {self.place} device type tensor to numpy")

    def untyped_storage(self):
        return self.held.untyped_storage()

    def new_tensor(self, data, *, dtype=None, device=None, requires_grad=False):
        return torch.tensor(data, dtype=dtype or self.dtype, device=device or self.place)

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        assert DeviceDouble.current is not None, (
            f"{func}: a tagged tensor outside of the double"
        )
        return DeviceDouble.current.run(func, args, kwargs or {})


class DeviceDouble(TorchDispatchMode):
    """``count`` GPUs."""

    current: DeviceDouble | None = None

    def __init__(self, count=1):
        super().__init__()
        self.count = count
        self.operators = 0  # run on tagged tensors so far
        self._generators = {}
        self._undo = []

    def __enter__(self):
        stack = ExitStack()
        for target, name, value in self._stand_ins():
            stack.enter_context(patch.object(target, name, value))
        overwriting = torch.__future__.get_overwrite_module_params_on_conversion()
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        stack.callback(
            torch.__future__.set_overwrite_module_params_on_conversion, overwriting
        )
        stack.callback(torch._C._set_only_lift_cpu_tensors, torch._C._only_lift_cpu_tensors())
        torch._C._set_only_lift_cpu_tensors(
            True
        )  # torch.tensor(..., device="cuda") comes by here
        self._undo.append((stack, DeviceDouble.current))
        DeviceDouble.current = self
        return super().__enter__()

    def __exit__(self, *error):
        super().__exit__(*error)
        stack, DeviceDouble.current = self._undo.pop()
        stack.close()

    def _stand_ins(self):
        """Yield stand-ins of PyTorch's questions about GPUs, other than operators."""
        double = self

        class Generator(torch.Generator):
            """A generator of the CPU; the double knows for which device it was made."""

            def __new__(cls, device="cpu"):
                made = super().__new__(cls, "cpu")
                double._generators[made._cdata] = double.known(torch.device(device))
                return made

            def __init__(self, device="cpu"):
                pass

        values = {
            "_lazy_init": lambda: None,
            "is_available": lambda: True,
            "device_count": lambda: self.count,
            "is_bf16_supported": lambda including_emulation=True: True,
            "mem_get_info": lambda device=None: (15 << 30, 15 << 30),
            "empty_cache": lambda: None,
        }
        yield from ((torch.cuda, name, value) for name, value in values.items())
        yield torch, "Generator", Generator
        # Tagged tensors cannot be inference tensors, which have no version, and views need one.
        grads = []
        yield (
            torch.inference_mode,
            "__enter__",
            lambda mode: grads.append(torch.set_grad_enabled(False)),
        )
        yield (
            torch.inference_mode,
            "__exit__",
            lambda mode, *error: grads.pop().__exit__(*error),
        )
        yield torch.amp.autocast_mode, "is_autocast_available", lambda kind: True
        yield torch.cuda.amp.common, "amp_definitely_not_available", lambda: False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return self.run(func, args, kwargs or {})

    def run(self, func, args, kwargs):
        """Run one operator: on CPU tensors as it is, on tagged ones with their values.

        Its results are tagged again.
        """
        tensors = [
            each for each in tree_flatten((args, kwargs))[0] if isinstance(each, torch.Tensor)
        ]
        tagged = [each for each in tensors if isinstance(each, Tagged)]
        wanted = (
            None
            if kwargs.get("device") is None
            else self.known(torch.device(kwargs["device"]))
        )
        if not tagged and (wanted is None or wanted.type == "cpu"):
            return func(*args, **kwargs)
        name = func._schema.name.removeprefix("aten::")
        self.operators += 1
        if name == "_has_compatible_shallow_copy_type":
            return False
        if name == "_fused_sdp_choice":
            return 0  # by its definition: kernels of a GPU cannot run here
        where = self._device_of_result(name, args, tensors, tagged, wanted)
        self._check_generator(name, kwargs.get("generator"), where)
        held = {id(each.held): each for each in tagged}
        if wanted is not None:
            kwargs = {**kwargs, "device": torch.device("cpu")}
        inner_args, inner_kwargs = tree_map(
            lambda x: x.held if isinstance(x, Tagged) else x, (args, kwargs)
        )
        out = func(*inner_args, **inner_kwargs)
        for each in tagged:
            assert each.held.shape == each.shape, (
                f"{name} changed a shape in place: the double cannot follow"
            )
        if name in ("copy_", "set_"):
            return args[0]

        def tag(value):
            if (
                not isinstance(value, torch.Tensor)
                or isinstance(value, Tagged)
                or where.type == "cpu"
            ):
                return value
            return held[id(value)] if id(value) in held else Tagged(value, where)

        return tree_map(tag, out)

    def known(self, device):
        """The device by its full name; "meta" is how PyTorch's own code calls the double's."""
        if device.type not in ("cuda", "meta"):
            return device
        index = device.index or 0
        if index >= self.count:
            raise RuntimeError("CUDA error: invalid device ordinal")
        return torch.device("cuda", index)

    def _device_of_result(self, name, args, tensors, tagged, wanted):
        if name == "copy_":
            return args[0].device
        if name == "_to_copy":
            return wanted or tagged[0].device
        # A GPU takes these from the CPU without an error.
        free = [each for each in tensors if not isinstance(each, Tagged) and each.dim() == 0]
        if name in INDEXING and isinstance(args[0], Tagged):
            free += [
                index
                for index in args[1]
                if index is not None and not isinstance(index, Tagged)
            ]
        met = {each.device for each in tensors if not any(each is other for other in free)}
        if len(met) > 1:
            found = ", ".join(sorted(map(str, met)))
            raise MixedDevicesError(
                f"{name}: expected all tensors to be on the same device, but found {found}"
            )
        return wanted or (tagged[0].device if tagged else torch.device("cpu"))

    def _check_generator(self, name, generator, where):
        made_for = self._generators.get(generator._cdata) if generator is not None else where
        if made_for != where:
            raise MixedDevicesError(
                f"{name}: a generator of {made_for} for a tensor on {where}"
            )
