"""The policy network: its LSTM is torch's, its rows stand alone, its inputs are normalized."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import LSTMModule, ProbabilisticActor

from agents.policies.actor import Actor, Head, Normalizer
from agents.policies.learned import actor_for
from agents.wrappers.correction import with_base
from coloc_env.envs.sb3 import CoLocVecEnv
from training.learning.mappo import policy_of
from training.learning.sb3_ppo import exported

INPUTS = {"base_std": 3, "residuals": 5}
WIDTH = 8


def actor(seed: int = 0, **options: Any) -> Actor:
    """One that has left its small first weights."""
    torch.manual_seed(seed)
    made = Actor({"name": "displacement"}, INPUTS, 3, hidden=16, **options)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(0.5 * torch.randn_like(parameter))
        made.body.normal.shift.copy_(torch.randn(WIDTH))
        made.body.normal.scale.copy_(torch.rand(WIDTH) + 0.5)
    return made.requires_grad_(False)


# ---------------------------------------------------------------- acting


def forward(made: Actor, x: NDArray) -> tuple[NDArray, NDArray]:
    """Mean and log-std of the feed-forward network, layer by layer."""
    w = {name: value.double().numpy() for name, value in made.state_dict().items()}
    x = ((x - w["body.normal.shift"]) / w["body.normal.scale"]).clip(-10, 10)
    for layer in range(2):
        x = np.tanh(x @ w[f"body.layers.{layer}.weight"].T + w[f"body.layers.{layer}.bias"])
    out = x @ w["head.layer.weight"].T + w["head.layer.bias"]
    return out[..., :3], out[..., 3:]


@pytest.mark.parametrize("squash", ["tanh", "clip"])
def test_without_memory_an_action_is_two_layers_and_a_head(squash: str) -> None:
    made = actor(squash=squash)
    x = 5 * torch.randn(4, 3, WIDTH)
    action, memory = made.act(x, x[..., :0])
    mean, log_std = forward(made, x.double().numpy())
    expected = np.tanh(mean) if squash == "tanh" else mean.clip(-1, 1)
    assert (np.abs(mean) > 1).any()
    np.testing.assert_allclose(action, expected, atol=1e-5)
    assert memory.shape == (4, 3, 0)
    assert made.memory_size == 0
    std = made.head(made.body(x.unsqueeze(-2)))[1][..., 0, :]
    np.testing.assert_allclose(std, np.exp(log_std).clip(1e-3, 2.0), rtol=1e-4)


def test_the_recurrent_step_is_torchs_lstm() -> None:
    """Step by step, against nn.LSTM over the whole sequence on the same weights."""
    made = actor(recurrent=True)
    assert made.lstm is not None
    x = 3 * torch.randn(7, 2, 3, WIDTH)
    embedded = made.body(x.unsqueeze(-2))[..., 0, :]
    sequences = embedded.flatten(1, 2).movedim(0, 1)
    out, (h, c) = made.lstm(sequences)
    expected = torch.tanh(made.head(out.unsqueeze(-2))[0][..., 0, :])
    memory = torch.zeros(2, 3, made.memory_size)
    assert made.memory_size == 32
    for step in range(7):
        action, memory = made.act(x[step], memory)
        found = action.flatten(0, 1)
        torch.testing.assert_close(found, expected[:, step], atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(memory[..., :16].flatten(0, 1), h[0], atol=2e-6, rtol=1e-5)
    torch.testing.assert_close(memory[..., 16:].flatten(0, 1), c[0], atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("recurrent", [False, True])
def test_the_best_action_is_that_of_torchrls_policy(recurrent: bool) -> None:
    """Through LSTMModule and TanhNormal, with an episode that restarts half-way."""
    made = actor(recurrent=recurrent)
    policy: ProbabilisticActor = policy_of(made)
    memory = torch.zeros(1, 5, made.memory_size)
    seen = TensorDict({"hidden": torch.zeros(5, 1, 16), "cell": torch.zeros(5, 1, 16)}, [5])
    for step in range(6):
        begins = torch.tensor([[False], [step == 3], [False], [step == 3], [False]])
        memory = memory.masked_fill(begins, 0.0)
        x = torch.randn(1, 5, WIDTH)
        seen["observation"], seen["is_init"] = x[0], begins
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            seen = policy(seen)
        action, memory = made.act(x, memory)
        torch.testing.assert_close(action[0], seen["action"], atol=2e-6, rtol=1e-5)
        if recurrent:
            seen = TensorDict({name: seen["next", name] for name in ("hidden", "cell")}, [5])


def test_lstm_module_in_a_sequence_is_the_recurrent_step() -> None:
    made = actor(recurrent=True)
    module = LSTMModule(
        lstm=made.lstm,
        in_keys=["embedded", "hidden", "cell"],
        out_keys=["out", ("next", "hidden"), ("next", "cell")],
        default_recurrent_mode=True,
    )
    x = torch.randn(4, 9, WIDTH)
    begins = torch.zeros(4, 9, 1, dtype=torch.bool)
    begins[1, 4] = begins[2, 7] = True
    zeros = torch.zeros(4, 9, 1, 16)
    embedded = TensorDictModule(made.body, ["observation"], ["embedded"])
    entries = {"observation": x, "is_init": begins, "hidden": zeros, "cell": zeros}
    whole = module(embedded(TensorDict(entries, [4, 9])))
    expected = torch.tanh(made.head(whole["out"])[0])
    memory = torch.zeros(1, 4, 32)
    for step in range(9):
        memory = memory.masked_fill(begins[:, step], 0.0)
        action, memory = made.act(x[None, :, step], memory)
        torch.testing.assert_close(action[0], expected[:, step], atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("recurrent", [False, True])
@given(worlds=st.integers(1, 40), uavs=st.integers(1, 7), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_a_uavs_numbers_do_not_depend_on_who_shares_its_batch(
    recurrent: bool, worlds: int, uavs: int, seed: int
) -> None:
    """To the last bit."""
    made = actor(recurrent=recurrent)
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(worlds, uavs, WIDTH, generator=g)
    memory = torch.randn(worlds, uavs, made.memory_size, generator=g)
    actions, after = made.act(x, memory)
    for b, n in ((0, 0), (worlds - 1, uavs - 1), (worlds // 2, uavs // 2)):
        row = slice(b, b + 1), slice(n, n + 1)
        alone, kept = made.act(x[row], memory[row])
        assert torch.equal(alone, actions[row])
        assert torch.equal(kept, after[row])


def test_an_untrained_actor_hardly_moves_and_explores() -> None:
    torch.manual_seed(0)
    made = Actor({"name": "displacement"}, INPUTS, 3, recurrent=True)
    action, _ = made.act(torch.randn(50, 6, WIDTH), torch.zeros(50, 6, made.memory_size))
    assert action.abs().max() < 0.02
    _, std = made.head(torch.zeros(1, 64))
    torch.testing.assert_close(std, torch.full((1, 3), 0.3))


def test_a_standard_deviation_has_bounds() -> None:
    head = Head(4, 1)
    nn.init.zeros_(head.layer.weight)
    for log_std, expected in ((-20.0, 1e-3), (20.0, 2.0), (-1.0, np.exp(-1.0))):
        nn.init.constant_(head.layer.bias, log_std)
        assert head(torch.zeros(1, 4))[1].item() == pytest.approx(expected)


def test_an_actor_describes_itself() -> None:
    made = actor(recurrent=True, squash="clip")
    assert made.features == ("base_std[3]", "residuals[5]")
    twin = Actor(**made.architecture)
    assert twin.architecture == made.architecture
    assert {n: p.shape for n, p in twin.state_dict().items()} == {
        n: p.shape for n, p in made.state_dict().items()
    }


# ---------------------------------------------------------------- normalizing


def test_a_normalizer_knows_what_is_usual() -> None:
    """A Gaussian's median and its percentiles 16 and 84: mean and standard deviation."""
    mean, std = np.array([3.0, -40.0, 0.5]), np.array([0.1, 20.0, 2.0])
    samples = mean + std * np.random.default_rng(0).normal(size=(20_000, 3))
    samples[:300] = 1e4  # as the first steps of an episode may be
    normal = Normalizer(3)
    normal.fit(torch.tensor(samples, dtype=torch.float32))
    np.testing.assert_allclose((normal.shift.numpy() - mean) / std, 0, atol=0.05)
    np.testing.assert_allclose(normal.scale, std, rtol=0.06)


def test_a_normalizer_is_the_quantiles_of_its_samples() -> None:
    samples = np.random.default_rng(1).exponential(size=(997, 2)).astype(np.float32)
    normal = Normalizer(2)
    normal.fit(torch.from_numpy(samples))
    low, middle, high = np.quantile(samples, (0.16, 0.5, 0.84), axis=0)
    np.testing.assert_allclose(normal.shift, middle, rtol=1e-5)
    np.testing.assert_allclose(normal.scale, (high - low) / 2, rtol=1e-5)
    x = np.array([[middle[0] + 2 * normal.scale[0].item(), -1e9]], np.float32)
    found = normal(torch.from_numpy(x))
    assert found[0, 0].item() == pytest.approx(2.0, rel=1e-5)
    assert found[0, 1].item() == -10.0


def test_an_input_that_never_changes_does_no_harm() -> None:
    normal = Normalizer(1)
    normal.fit(torch.full((50, 1), 7.0))
    assert normal(torch.tensor([[7.0]])).item() == 0.0
    assert normal(torch.tensor([[8.0]])).item() == 10.0


def test_normalizing_is_learned_by_nobody_and_saved() -> None:
    made = actor()
    assert {"body.normal.shift", "body.normal.scale"} <= set(made.state_dict())
    assert not any("normal" in name for name, _ in made.named_parameters())


# ---------------------------------------------------------------- from stable-baselines3


@pytest.mark.parametrize("base", ["none", "ekf"])
def test_an_exported_policy_acts_like_the_original(base: str) -> None:
    """The best actions of PPO.predict on what VecNormalize makes of observations."""
    action = "displacement" if base == "none" else "estimate"
    worlds = CoLocVecEnv(num_worlds=4, action=action, n_uavs=2, horizon=10, motion="random")
    if base != "none":
        worlds = with_base(worlds, base)
    env = VecNormalize(worlds, gamma=0.5)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=10,
        batch_size=40,
        policy_kwargs={"net_arch": [16, 16]},
        seed=0,
        device="cpu",
    )
    model.learn(160)
    policy: Any = model.policy
    with torch.no_grad():
        policy.action_net.weight.mul_(100)  # so that some actions are cut
        policy.log_std.copy_(torch.tensor([-1.0, 0.0, 0.5]))
    made = actor_for(worlds.mode, hidden=16, squash="clip")
    exported(model, env, made)
    env.training = False
    normalized: Any = env.reset()
    cut = 0
    for _ in range(12):
        expected, _ = model.predict(normalized, deterministic=True)
        seen = torch.from_numpy(env.get_original_obs()).view(4, 2, -1)
        found, _ = made.act(seen, seen[..., :0])
        np.testing.assert_allclose(found.reshape(8, 3).detach(), expected, atol=2e-4)
        cut += (np.abs(expected) == 1).sum()
        normalized, *_ = env.step(expected)
    assert 0 < cut < 12 * 24
    std = made.head(torch.randn(5, 16))[1]
    torch.testing.assert_close(std, torch.tensor([-1.0, 0.0, 0.5]).exp().expand(5, 3))


def test_a_saved_actor_is_moved_by_no_later_training() -> None:
    """``exported`` copies."""
    worlds = CoLocVecEnv(action="displacement", n_uavs=2, horizon=10)
    env = VecNormalize(worlds)
    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [8, 8]}, device="cpu")
    made = actor_for(worlds.mode, hidden=8, squash="clip")
    exported(model, env, made)
    kept: dict[str, Tensor] = {n: p.clone() for n, p in made.state_dict().items()}
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(1.0)
    env.reset()
    statistics: Any = env.obs_rms
    statistics.mean += 1.0
    assert all(torch.equal(p, kept[n]) for n, p in made.state_dict().items())
