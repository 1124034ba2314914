"""Multi-layer perceptrons in compiled code.

A row's numbers do not depend on the rows beside it: the same loop computes any four rows. So the results are
the same for any number of threads, which share the rows.
"""

import ctypes
from typing import Any

import numba
import numba.extending
import numpy as np
from numba import types

from sb3_mcbs.models.compiling import JIT_IS_OFF, OPTIONS, compiled, specialize
from sb3_mcbs.types import ACTIVATIONS, Layer, PolicyArrays

#: Rows that are computed together: each weight is read once for all of them.
TILE = 4

N_IN, N_OUT = Layer._fields.index("n_in"), Layer._fields.index("n_out")

_RELU, _TANH = ACTIVATIONS["relu"], ACTIVATIONS["tanh"]

# Sums may be reordered here, unlike in families: torch orders them in its own way as well.
_FAST = numba.njit(fastmath={"contract", "reassoc"}, **OPTIONS)


@numba.extending.intrinsic
def _pointer(_context: Any, _address: Any) -> Any:
    """The address as a pointer to float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float32)(types.int64), generate


@compiled
def _floats_at(address: int, rows: int, columns: int) -> np.ndarray:
    return numba.carray(_pointer(address), (rows, columns))  # type: ignore[call-arg]


def _floats_at_in_python(address: int, rows: int, columns: int) -> np.ndarray:
    values = (ctypes.c_float * int(rows * columns)).from_address(int(address))
    return np.ctypeslib.as_array(values).reshape(rows, columns)


#: The array ``[rows, columns]`` at an address.
floats_at = _floats_at_in_python if JIT_IS_OFF else _floats_at


@_FAST
def _products_of_tile(x: np.ndarray, weight: np.ndarray, bias: np.ndarray, out: np.ndarray) -> None:
    """``out = x @ weight.T + bias`` for four rows ``[4, features]``."""
    n_out, n_in = weight.shape
    x0, x1, x2, x3 = x[0, :n_in], x[1, :n_in], x[2, :n_in], x[3, :n_in]
    for j in range(0, n_out - 1, 2):  # two outputs at once: each input is read once for both
        u, v = weight[j], weight[j + 1]
        p0 = p1 = p2 = p3 = q0 = q1 = q2 = q3 = np.float32(0)
        for k in range(n_in):
            p0 += x0[k] * u[k]
            p1 += x1[k] * u[k]
            p2 += x2[k] * u[k]
            p3 += x3[k] * u[k]
            q0 += x0[k] * v[k]
            q1 += x1[k] * v[k]
            q2 += x2[k] * v[k]
            q3 += x3[k] * v[k]
        out[0, j], out[1, j], out[2, j], out[3, j] = p0 + bias[j], p1 + bias[j], p2 + bias[j], p3 + bias[j]
        j += 1
        out[0, j], out[1, j], out[2, j], out[3, j] = q0 + bias[j], q1 + bias[j], q2 + bias[j], q3 + bias[j]
    if n_out % 2:
        j = n_out - 1
        u = weight[j]
        p0 = p1 = p2 = p3 = np.float32(0)
        for k in range(n_in):
            p0 += x0[k] * u[k]
            p1 += x1[k] * u[k]
            p2 += x2[k] * u[k]
            p3 += x3[k] * u[k]
        out[0, j], out[1, j], out[2, j], out[3, j] = p0 + bias[j], p1 + bias[j], p2 + bias[j], p3 + bias[j]


def _products_in_python(x: np.ndarray, weight: np.ndarray, bias: np.ndarray, out: np.ndarray) -> None:
    out[:, : len(weight)] = x[:, : weight.shape[1]] @ weight.T + bias


_products = _products_in_python if JIT_IS_OFF else _products_of_tile


@compiled
def _activate(values: np.ndarray, activation: int) -> None:
    if activation == _RELU:
        for i in range(len(values)):
            if values[i] < 0:  # which keeps NaN, as torch does
                values[i] = 0
    elif activation == _TANH:
        for i in range(len(values)):
            values[i] = np.tanh(values[i])


@compiled
def _run_layer(layer: np.ndarray, x: np.ndarray, out: np.ndarray) -> None:
    """One layer for all rows.

    :param layer: ``[7]``, a row of the table.
    :param x: ``[rows, width]``, the input, overwritten.
    :param out: ``[rows, width]``, the output.
    """
    gain, shift, weight, bias, n_in, n_out, activation = layer
    if gain:
        gains, shifts = floats_at(gain, 1, n_in)[0], floats_at(shift, 1, n_in)[0]
        for row in range(len(x)):
            for i in range(n_in):
                x[row, i] = x[row, i] * gains[i] + shifts[i]
    weights, biases = floats_at(weight, n_out, n_in), floats_at(bias, 1, n_out)[0]
    for start in range(0, len(x), TILE):
        _products(x[start : start + TILE], weights, biases, out[start : start + TILE])
    for row in range(len(x)):
        _activate(out[row, :n_out], activation)


@compiled
def as_seen(policy: PolicyArrays, observation: np.ndarray, seen: np.ndarray) -> None:
    """Turn an observation of the environment into that of the networks.

    :param policy: contains the normalisation.
    :param observation: ``[obs_dim]``.
    :param seen: ``[obs_dim]`` float32, written.
    """
    for i in range(len(observation)):
        value = observation[i]
        if len(policy.mean):
            value = min(max((value - policy.mean[i]) / policy.deviation[i], -policy.clip), policy.clip)
        seen[i] = value


@compiled
def _padded(n_rows: int, network: np.ndarray) -> np.ndarray:
    """Room for the widest layer, in whole tiles."""
    width = max(network[:, N_IN].max(), network[:, N_OUT].max())
    return np.zeros(((n_rows + TILE - 1) // TILE * TILE, width), dtype=np.float32)


@compiled
def act(policy: PolicyArrays, observations: np.ndarray, rows: np.ndarray, actions: np.ndarray) -> None:
    """The actor's actions for some rows.

    :param policy: the actor.
    :param observations: ``[n, obs_dim]``, as the environment returns them.
    :param rows: which rows.
    :param actions: ``[n, act_dim]`` float32, written there.
    """
    x, out = _padded(len(rows), policy.actor), _padded(len(rows), policy.actor)
    for number in range(len(rows)):
        as_seen(policy, observations[rows[number]], x[number])
    for layer in policy.actor:
        _run_layer(layer, x, out)
        x, out = out, x
    for number in range(len(rows)):
        actions[rows[number]] = x[number, : actions.shape[1]]


@compiled
def evaluate(
    policy: PolicyArrays, observations: np.ndarray, actions: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """The critics' values for some rows.

    :param policy: contains the critics.
    :param observations: ``[n, obs_dim]``, as the environment returns them.
    :param actions: ``[n, act_dim]`` float32, scaled.
    :param rows: which rows.
    :return: ``[rows]`` float32.
    """
    obs_dim, n_inputs = observations.shape[1], observations.shape[1] + actions.shape[1]
    values = np.full(len(rows), np.float32(0 if policy.averages else np.inf))
    n_estimates = 0
    for critic in policy.critics:
        x, out = _padded(len(rows), critic), _padded(len(rows), critic)
        for number in range(len(rows)):
            as_seen(policy, observations[rows[number]], x[number])
            x[number, obs_dim:n_inputs] = actions[rows[number]]
        for layer in critic:
            _run_layer(layer, x, out)
            x, out = out, x
        n_outputs = critic[-1, N_OUT]
        n_estimates += n_outputs
        for number in range(len(rows)):
            for j in range(n_outputs):
                if policy.averages:
                    values[number] += x[number, j]
                elif x[number, j] < values[number] or np.isnan(x[number, j]):
                    values[number] = x[number, j]
    return values / np.float32(n_estimates) if policy.averages else values


def _actions_of(policy: PolicyArrays, observations: np.ndarray, act_dim: int) -> np.ndarray:
    actions = np.empty((len(observations), act_dim), dtype=np.float32)
    act(policy, observations, np.arange(len(observations)), actions)
    return actions


def _values_of(policy: PolicyArrays, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
    return evaluate(policy, observations, actions, np.arange(len(observations)))


#: The actor's actions and the critics' values for all rows, to be called from Python.
actions_of, values_of = specialize(_actions_of, "policy"), specialize(_values_of, "policy")
