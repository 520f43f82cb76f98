"""Any module of torch as a member of an ensemble, trained online by its own autograd."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from usvlearn.core.protocol import Estimator
from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError, ShapeError, check_choice, check_positive
from usvlearn.estimators.external.inputs import X, x_of

INPUTS = len(X._fields) - 1  # without the speed
FIRST, SECOND, TINY = 0.9, 0.999, 1e-8  # of Adam


class OnlineModuleState(NamedTuple):
    """What is known of a module."""

    x: Tensor  # (*batch, states) first the speed, m/s
    weights: Tensor  # (*batch, W) all that are trained
    moments: Tensor  # (*batch, 2, W) of their gradients; of Adam
    updates: Tensor  # (*batch,) how many there were
    before: Tensor  # (*batch, window, states) x before each of the last measured steps, the last one last
    inputs: Tensor  # (*batch, window, 8) of these steps
    targets: Tensor  # (*batch, window) measured at their ends, m/s
    held: Tensor  # (*batch,) how many of them follow each other


class OnlineModule(Estimator):
    """A module x⁺ = net(x, u), whose weights learn after each measured step from the last `window` ones.

    x is `(1, states)`: first the speed, m/s, then whatever the module remembers, 0 where a segment starts. u is
    `(1, 8)`: left, right, mean, mean_square, sin, cos, yaw_rate, dt (`estimators.external.inputs`). A measured speed
    replaces the predicted one. Where the module has a method `project()`, it is called after each update, to bring the
    weights back to where they may be. The module is copied, and its numbers become float64.

    Args:
        net: the module; parameters with `requires_grad` are trained.
        states: length of x, a count.
        optimizer: "adam" (Kingma and Ba 2015) or "sgd".
        lr: learning rate, no unit.
        window: steps through which gradients pass, a count.

    Raises:
        ConfigError: nothing to train, or an argument outside its legal values.

    >>> class Drag(nn.Module):
    ...     def __init__(self):
    ...         super().__init__()
    ...         self.layer = nn.Linear(9, 1)
    ...
    ...     def forward(self, x, u):
    ...         return x + self.layer(torch.cat([x, u], -1)) * u[:, -1:]
    >>> module = OnlineModule(Drag(), lr=1e-2)
    >>> module.init((2,)).weights.shape
    torch.Size([2, 10])
    """

    def __init__(self, net: nn.Module, states: int = 1, optimizer: str = "adam", lr: float = 1e-3, window: int = 5):
        super().__init__()
        if not isinstance(net, nn.Module):
            raise ConfigError(f"net: found {net!r}, expected a module of torch")
        self.net = copy.deepcopy(net).double()
        self.states, self.window = (
            int(check_positive(name, value)) for name, value in (("states", states), ("window", window))
        )
        self.adam, self.lr = check_choice("optimizer", optimizer, ("adam", "sgd")) == "adam", check_positive("lr", lr)
        trained = {name: each for name, each in self.net.named_parameters() if each.requires_grad}
        if not trained:
            raise ConfigError("net: found no parameters that are trained, expected some with requires_grad")
        self._shapes = {name: each.shape for name, each in trained.items()}

    def init(self, batch: Sequence[int] = ()) -> OnlineModuleState:
        parameters = dict(self.net.named_parameters())
        weights = torch.cat([parameters[name].detach().reshape(-1) for name in self._shapes])
        batch, count, n = tuple(batch), len(weights), self.window

        def zeros(*shape: int) -> Tensor:
            return weights.new_zeros((*batch, *shape))

        return OnlineModuleState(
            zeros(self.states), weights.expand(*batch, count).clone(), zeros(2, count), zeros(),
            zeros(n, self.states), zeros(n, INPUTS), zeros(n), zeros(),
        )  # fmt: skip

    def start(self, state: OnlineModuleState, surge: Tensor) -> OnlineModuleState:
        x = torch.cat([surge[..., None], torch.zeros_like(state.x[..., 1:])], -1)
        return state._replace(x=x, held=torch.zeros_like(state.held))

    def predict(self, state: OnlineModuleState, inputs: Inputs) -> tuple[OnlineModuleState, Tensor]:
        x = self._each(state, self._inputs(inputs))
        return state._replace(x=x, held=torch.zeros_like(state.held)), x[..., 0]

    def update(self, state: OnlineModuleState, inputs: Inputs, surge: Tensor) -> OnlineModuleState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: OnlineModuleState, inputs: Inputs, surge: Tensor) -> tuple[OnlineModuleState, Tensor]:
        u = self._inputs(inputs)
        ahead = self._each(state, u)
        new = state._replace(
            x=torch.cat([surge[..., None], ahead[..., 1:]], -1),
            before=torch.cat([state.before[..., 1:, :], state.x[..., None, :]], -2),
            inputs=torch.cat([state.inputs[..., 1:, :], u[..., None, :]], -2),
            targets=torch.cat([state.targets[..., 1:], surge[..., None]], -1),
            held=(state.held + 1).clamp(max=self.window),
            updates=state.updates + 1,
        )
        batch = surge.shape
        rows = [tree.reshape(-1, *tree.shape[len(batch) :]).unbind(0) for tree in new]
        trained = [self._trained(OnlineModuleState(*each)) for each in zip(*rows, strict=True)]
        weights, moments = (torch.stack(each).reshape(*batch, *each[0].shape) for each in zip(*trained, strict=True))
        return new._replace(weights=weights, moments=moments), ahead[..., 0]

    def trained(self, state: OnlineModuleState) -> nn.Module:
        """A copy of the module with the weights of a state of one vehicle, such as for `certify.certify`.

        Args:
            state: of one vehicle; of a batch index its leaves.

        Returns:
            The module.

        >>> module = OnlineModule(nn.Bilinear(1, 8, 1))
        >>> type(module.trained(module.init())).__name__
        'Bilinear'
        """
        net = copy.deepcopy(self.net)
        net.load_state_dict(self._named(state.weights), strict=False)
        return net

    def _inputs(self, inputs: Inputs) -> Tensor:
        return torch.stack(x_of(torch.zeros_like(inputs.dt), inputs)[1:], -1)

    def _named(self, weights: Tensor) -> dict[str, Tensor]:
        parts = weights.split([shape.numel() for shape in self._shapes.values()])
        return {name: part.view(shape) for (name, shape), part in zip(self._shapes.items(), parts, strict=True)}

    def _ahead(self, weights: Mapping[str, Tensor], x: Tensor, u: Tensor) -> Tensor:
        """One step of one vehicle."""
        result = functional_call(self.net, dict(weights), (x[None], u[None]))
        if result.shape != (1, self.states):
            raise ShapeError(f"net: found a result of the shape {tuple(result.shape)}, expected (1, {self.states})")
        return result[0]

    @torch.no_grad()
    def _each(self, state: OnlineModuleState, u: Tensor) -> Tensor:
        """One step of all vehicles."""
        rows = [tree.reshape(-1, tree.shape[-1]).unbind(0) for tree in (state.weights, state.x, u)]
        ahead = [self._ahead(self._named(w), x, inputs) for w, x, inputs in zip(*rows, strict=True)]
        return torch.stack(ahead).reshape(state.x.shape)

    def _trained(self, new: OnlineModuleState) -> tuple[Tensor, Tensor]:
        """The weights of one vehicle after an update, and the moments of their gradients."""
        first = self.window - int(new.held)
        with torch.enable_grad():
            weights = new.weights.detach().requires_grad_()
            named, x, loss = self._named(weights), new.before[first].detach(), weights.new_zeros(())
            for u, target in zip(new.inputs[first:], new.targets[first:], strict=True):
                ahead = self._ahead(named, x, u)
                loss = loss + (ahead[0] - target).square()
                x = torch.cat([target[None], ahead[1:]])
            (slope,) = torch.autograd.grad(loss / (self.window - first), weights)
        moments = new.moments
        if self.adam:
            n, (mean, square) = new.updates, moments
            moments = torch.stack([mean.lerp(slope, 1 - FIRST), square.lerp(slope.square(), 1 - SECOND)])
            slope = (moments[0] / (1 - FIRST**n)) / ((moments[1] / (1 - SECOND**n)).sqrt() + TINY)
        weights = weights.detach() - self.lr * slope
        if hasattr(self.net, "project"):
            net: nn.Module = self.trained(new._replace(weights=weights))
            with torch.no_grad():
                net.project()  # type: ignore[operator]  # a method of a module of one's own
            parameters = dict(net.named_parameters())
            weights = torch.cat([parameters[name].detach().reshape(-1) for name in self._shapes])
        return weights, moments
