"""Dropout masks: fixed by the seed, the same for a map alone and in a batch, and one
for all cells of a map.
"""

import torch

from benchnav.core.terrain import Observation
from tests.models.nets.test_mdn import layers, observe
from tests.models.zoo.support import make


def test_masks_are_of_the_seed_alone_and_kept_with_the_weights() -> None:
    first, again, other = (
        make("mc_dropout"),
        make("mc_dropout"),
        make("mc_dropout", seed=1),
    )
    assert torch.equal(first.masks, again.masks)
    assert not torch.equal(first.masks, other.masks)
    assert "masks" in first.state_dict()
    other.load_state_dict(first.state_dict())
    assert torch.equal(
        other.predict(observe(1, 16, 16)).means, first.predict(observe(1, 16, 16)).means
    )


def test_channels_are_left_out_as_often_as_asked_for() -> None:
    for dropout in (0.1, 0.5):
        masks = make("mc_dropout", dropout=dropout, masks=400).masks
        assert abs(1 - float(masks.float().mean()) - dropout) < 0.01
        assert bool((masks.float().mean(0) < 1).all())


def test_a_prediction_hangs_neither_on_the_batch_nor_on_generators() -> None:
    network, seen = make("mc_dropout"), observe(3, 16, 16)
    before = torch.random.get_rng_state()
    whole = network.predict(seen)
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.manual_seed(7)
    alone = network.predict(
        Observation(
            seen.rgb[1:2], seen.elevation_m[1:2], seen.slope_deg[1:2], seen.grid
        )
    )
    assert whole.means.shape == (3, 5, 16, 16)
    torch.testing.assert_close(alone.means, whole.means[1:2], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(alone.stds, whole.stds[1:2], rtol=1e-5, atol=1e-6)


def test_each_component_is_the_network_without_the_channels_of_its_mask() -> None:
    network, seen = make("mc_dropout"), observe(1, 16, 16)
    with torch.no_grad():
        means, _ = network(layers(seen))
        features = network.features(layers(seen))
        for place, mask in enumerate(network.masks):
            one, two, three = mask.split([33, 16, 16])
            weights = [
                layer.weight.clone()
                for layer in (network.joint[0], network.joint[2], network.head)
            ]
            first, second, third = (
                torch.einsum("oi,i->oi", weight[:, :, 0, 0], part / 0.8)
                for weight, part in zip(weights, (one, two, three), strict=True)
            )
            silu, biases = (
                torch.nn.functional.silu,
                [network.joint[0].bias, network.joint[2].bias, network.head.bias],
            )
            cells = features[0].flatten(1)
            hidden = silu(
                second @ silu(first @ cells + biases[0][:, None]) + biases[1][:, None]
            )
            expected = (third @ hidden + biases[2][:, None])[0].view(16, 16)
            torch.testing.assert_close(means[0, place], expected, rtol=1e-4, atol=1e-5)


def test_training_draws_a_mask_for_each_map() -> None:
    network, seen = make("mc_dropout"), observe(2, 16, 16)
    both = {name: torch.cat([layer[:1]] * 2) for name, layer in layers(seen).items()}
    network.train()
    torch.manual_seed(3)
    with torch.no_grad():
        first, again = network(both)[0], network(both)[0]
        torch.manual_seed(3)
        same = network(both)[0]
    assert first.shape == (2, 1, 16, 16)
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first, again)
    assert torch.equal(first, same)
