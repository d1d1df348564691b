"""A scene whose named numbers are learned."""

import dataclasses
import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lcplearn.datasets.recordings import Windows
from lcplearn.domains import POSITIVE, Domain, check
from lcplearn.formulations.formulation import Formulation
from lcplearn.formulations.line.formulation import path_error, step_error
from lcplearn.scenes.scene import Drive, Scene, Step
from lcplearn.scenes.sliding_block import SlidingBlock

Number = float | Sequence[float] | Sequence[Sequence[float]]


class Identified(Formulation):
    """Learn named numbers of a scene: the scene's own step, with parameters in their place.

    A number stays in the domain that the scene declares for it (its `numbers`): those with a lower end
    only are learned as the logarithm of their distance from it, those between two ends as a logit.

    Args:
        scene: Class of the scene, or its dotted name: a dataclass with `numbers` and `advance`.
        dt: Time step [s].
        given: Known values by name, lists for tensors; those that the scene has no use for are left aside.
        learn: Start of each learned number, or list of numbers, by name.
        fixed: Values by name that are neither learned nor told by data: how the scene is to step, say.
        clip: Times the median norm of the windows' gradients at which each is clipped; None leaves them alone. A
            window whose body is about to land on another corner has a thousand times the gradient of others. 10 is
            right for tosses; 2 biases friction.

    Raises:
        ValueError: scene can't be imported or has no numbers, learn names none of them or starts outside its domain,
            fixed names what the scene has not or what is learned, a value that the scene needs is neither given
            nor learned, a list is no array of numbers, or clip is not positive.
    """

    def __init__(
        self,
        *,
        scene: str | type,
        dt: float,
        learn: Mapping[str, Number],
        given: Mapping[str, Any] | None = None,
        fixed: Mapping[str, Any] | None = None,
        clip: float | None = None,
    ) -> None:
        kind = _class(scene)
        fields = {field.name: field for field in dataclasses.fields(kind) if field.init}
        domains: Mapping[str, Domain] = kind.numbers
        unknown = [name for name in learn if name not in domains]
        if unknown or not learn:
            got = unknown[0] if unknown else "none"
            raise ValueError(f"learn: expected numbers of {kind.__name__} ({', '.join(domains)}), got {got}")
        odd = [name for name in fixed or {} if name not in fields.keys() - {"dt", *learn}]
        if odd:
            raise ValueError(f"fixed: expected arguments of {kind.__name__} that are not learned, got {odd[0]}")
        check(POSITIVE, clip=clip)
        given = {**(given or {}), **(fixed or {})}
        known = {name: value for name, value in given.items() if name in fields.keys() - {"dt", *learn}}
        missing = [
            name
            for name, field in fields.items()
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            if name not in ("dt", *known, *learn)
        ]
        if missing:
            raise ValueError(
                f"given: expected {', '.join(missing)} of {kind.__name__}, got {', '.join(known) or 'none'}"
            )
        learned = {name: domains[name] for name in learn}
        starts = {name: _free(f"learn.{name}", value, domains[name]) for name, value in learn.items()}
        known = {name: _tensor(name, value) if isinstance(value, list) else value for name, value in known.items()}
        start = kind(dt=dt, **known, **{name: _tensor(name, value) for name, value in learn.items()})
        super().__init__(space=start.space, dt=dt, given=known)
        self.fixed = known
        self.contacts, self.radius = start.contacts, getattr(start, "length", 1.0)
        self.scene_type, self.domains, self.clip = kind, learned, clip
        self.softens = "temperature" in fields
        self.free = nn.ParameterDict(starts)

    def numbers(self) -> dict[str, Tensor]:
        """The learned numbers, differentiable."""
        return self.bound({name: self.free[name] for name in self.domains})

    def bound(self, free: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The numbers that free parameters, which may be any number, stand for."""
        return {name: _bound(free[name], domain) for name, domain in self.domains.items()}

    def moving(self) -> Scene:
        return self._scene(self.numbers())

    def _scene(self, learned: Mapping[str, Tensor]) -> Scene:
        softened = {"temperature": self.temperature} if self.temperature and self.softens else {}
        device = next(iter(learned.values())).device
        fixed = {name: value.to(device) if isinstance(value, Tensor) else value for name, value in self.fixed.items()}
        scene: Scene = self.scene_type(dt=self.dt, **{**fixed, **learned, **softened})
        return scene

    def moving_each(self, count: int) -> Scene:
        """As `moving`; to clip gradients one by one each of count windows has numbers of its own."""
        if self.clip is None:
            return self.moving()
        free = torch.cat([self.free[name].reshape(-1) for name in self.domains]).expand(count, -1)
        if free.requires_grad:
            free.register_hook(lambda gradients: clip_rows(gradients, self.clip))
        parts = free.split([self.free[name].numel() for name in self.domains], dim=-1)
        return self._scene(
            self.bound(
                {
                    name: part.reshape(count, *self.free[name].shape)
                    for name, part in zip(self.domains, parts, strict=True)
                }
            )
        )

    def advance(self, state: Float[Tensor, "*batch nq_plus_nv"], drive: Drive) -> Step:
        return self.moving().advance(state, drive)

    def errors(self) -> dict[str, Callable[[Windows], Tensor]]:
        """Beside the usual: violation, where the scene has it."""
        more = {"violation": self._violation_error} if hasattr(self.scene_type, "violation") else {}
        return super().errors() | more

    def _violation_error(self, windows: Windows) -> Float[Tensor, "B k"]:
        scene: Any = self.moving_each(windows.valid.numel())
        before, after = windows.states[:, :-1].flatten(0, 1), windows.states[:, 1:].flatten(0, 1)
        found: Tensor = scene.violation(before, windows.drive.map(lambda values: values.flatten(0, 1)), after)
        return found.reshape(windows.valid.shape)

    def physical_parameters(self) -> dict[str, float]:
        values: dict[str, float] = {}
        for name, value in self.numbers().items():
            flat = value.detach().reshape(-1).tolist()
            values |= {name if value.ndim == 0 else f"{name}_{k}": number for k, number in enumerate(flat, start=1)}
        return values


class Physical(Identified):
    """Learn friction coefficient and mass of a sliding block.

    Args:
        dt: Time step [s].
        gravity: Acceleration of gravity [m/s^2].
        initial_mu: Friction coefficient at the start; > 0, well below the expected one: if no sample is predicted to
            slip, the prediction loss has no gradient.
        initial_mass: Mass [kg] at the start, or for good if it isn't learned; > 0.
        learn_mass: False keeps the mass, for instance where no force is applied and it has no effect.
    """

    def __init__(
        self,
        *,
        dt: float,
        gravity: float = 9.81,
        initial_mu: float = 0.1,
        initial_mass: float = 1.0,
        learn_mass: bool = True,
    ) -> None:
        learn, given = {"mu": initial_mu}, {"gravity": gravity}
        (learn if learn_mass else given)["mass"] = initial_mass
        super().__init__(scene=SlidingBlock, dt=dt, learn=learn, given=given)
        # A mass that is not learned is for data without force, where it has no effect: they may have another.
        self.given = {"gravity": gravity}
        self.register_load_state_dict_pre_hook(_rename)

    def prediction_error(self, windows: Windows) -> Float[Tensor, " B"]:
        return step_error(self._next_velocity(), windows)

    def rollout_error(self, windows: Windows) -> Float[Tensor, "B k"]:
        return path_error(self._next_velocity(), windows)

    def _next_velocity(self) -> Callable[..., Tensor]:
        block: Any = self.moving()
        return lambda velocity, force, friction: block.next_velocity(velocity, force)


def _rename(module: nn.Module, state: dict[str, Any], prefix: str, *others: Any) -> None:
    """Checkpoints from before `Identified` call the logarithms log_mu and log_mass; they have a fixed mass, too."""
    for name in ("mu", "mass"):
        value = state.pop(f"{prefix}log_{name}", None)
        if value is not None and f"free.{name}" in dict(module.named_parameters()):
            state[f"{prefix}free.{name}"] = value


def _class(scene: str | type) -> Any:
    if isinstance(scene, str):
        module, _, name = scene.rpartition(".")
        try:
            found = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError):
            raise ValueError(f"scene: expected the dotted name of a class, got {scene!r}") from None
    else:
        found = scene
    if not (dataclasses.is_dataclass(found) and hasattr(found, "numbers") and hasattr(found, "advance")):
        raise ValueError(f"scene: expected a dataclass with `numbers` and `advance`, got {scene!r}")
    return found


def _free(name: str, value: Number, domain: Domain) -> nn.Parameter:
    """The parameter, free of bounds, of a number in its domain."""
    start = _tensor(name, value)
    inside = all(number in domain and number not in (domain.low, domain.high) for number in start.reshape(-1).tolist())
    if not inside:
        raise ValueError(f"{name}: expected {domain.words}, inside its bounds, got {value}")
    if math.isinf(domain.low):
        return nn.Parameter(start / domain.unit)
    if math.isinf(domain.high):
        return nn.Parameter((start - domain.low).log())
    return nn.Parameter(((start - domain.low) / (domain.high - domain.low)).logit())


def clip_rows(gradients: Float[Tensor, "N P"], most: float) -> Float[Tensor, "N P"]:
    """Clip each row at most times the median norm of those that are not 0; a row that is not finite becomes 0.

    Where no row is finite and not 0 they stay as they are: a training without any gradient must not go on in silence.
    """
    norms = gradients.norm(dim=-1)
    fine = norms.isfinite() & (norms > 0.0)
    if not bool(fine.any()):
        return gradients
    factor = (most * norms[fine].median() / norms).clamp(max=1.0)
    return torch.where(fine.unsqueeze(-1), gradients * factor.unsqueeze(-1), 0.0)


def _tensor(name: str, value: Any) -> Tensor:
    try:
        return torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected a number, or lists of numbers of one length, got {value!r}") from None


def _bound(free: Tensor, domain: Domain) -> Tensor:
    if math.isinf(domain.low):
        return free * domain.unit
    if math.isinf(domain.high):
        return domain.low + free.exp()
    return domain.low + (domain.high - domain.low) * free.sigmoid()
