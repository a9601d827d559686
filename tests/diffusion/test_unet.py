"""The network: shapes, size, cost, context vector and the withheld descriptor."""

import math
import subprocess
import sys

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from inflate_lib.diffusion import TrainingConfig, UNet
from inflate_lib.diffusion.unet import CONDITIONINGS, ResidualBlock, _Attention, sinusoidal_embedding


def shaken(**options):
    """A small network whose last layers no longer start at zero."""
    net = UNet(**{"n_conditions": 2, "channels": (8, 16), "embedding": 16, "hidden": 8} | options)
    g = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in net.parameters():
            p += 0.1 * torch.randn(p.shape, generator=g)
    return net


def inputs(n=3, size=28, n_conditions=2):
    g = torch.Generator().manual_seed(1)
    x = torch.randn(n, 1, size, size, generator=g)
    return x, torch.randint(1000, (n,), generator=g), torch.rand(n, n_conditions, generator=g)


OPTIONS = [
    {},
    {"attention": True},
    {"conditioning": "add"},
    {"blocks": 2},
    {"blocks": 3, "channels": (8,)},
    {"channels": (6, 9, 10)},
    {"channels": (8,)},
]


@pytest.mark.parametrize("options", OPTIONS)
def test_answers_have_the_shape_of_the_images(options):
    net = shaken(**options)
    answer = net(*inputs())
    assert answer.shape == (3, 1, 28, 28) and bool(torch.isfinite(answer).all())
    answer.square().mean().backward()  # every weight takes part, the null vector where a descriptor is withheld
    assert all(p.grad is not None for name, p in net.named_parameters() if name != "null")


@pytest.mark.parametrize(("n_conditions", "expected"), [(1, 7_454_873), (2, 7_455_073), (60, 7_466_673)])
def test_number_of_parameters_of_the_papers_network(n_conditions, expected):
    net = TrainingConfig(epochs=150).make_net(n_conditions)
    assert net.n_parameters == expected
    assert expected - 7_454_873 == 200 * (n_conditions - 1)  # N enters the first layer of the descriptor network only


def test_number_of_parameters_with_more_blocks_or_added_context():
    def of_a_block(c):  # two normalisations, two convolutions, the context's scale and shift
        return 4 * c + 2 * (9 * c * c + c) + 2 * c * (256 + 1)

    more = UNet(1, blocks=2).n_parameters - UNet(1).n_parameters
    assert more == 2 * sum(map(of_a_block, (64, 128, 256)))
    less = UNet(1).n_parameters - UNet(1, conditioning="add").n_parameters
    assert less == (2 * (64 + 128 + 256) + 2 * 256) * (256 + 1)  # no scale: eight blocks, down, up and in the middle


@pytest.mark.parametrize("conditioning", CONDITIONINGS)
def test_context_enters_a_residual_block_as_written(conditioning):
    torch.manual_seed(0)
    block = ResidualBlock(4, 4, 6, groups=2, scale_shift=conditioning == "scale-shift").double()
    torch.nn.init.normal_(block.conv2.weight)
    x, context = torch.randn(2, 4, 5, 5).double(), torch.randn(2, 6).double()
    h = block.conv1(torch.nn.functional.silu(block.norm1(x)))
    told = (context @ block.context.weight.T + block.context.bias)[:, :, None, None]
    h = {
        "add": lambda: block.norm2(h + told),  # Ho et al. (2020)
        "scale-shift": lambda: block.norm2(h) * (1 + told[:, :4]) + told[:, 4:],  # Nichol & Dhariwal (2021)
    }[conditioning]()
    expected = x + block.conv2(torch.nn.functional.silu(h))
    torch.testing.assert_close(block(x, context), expected)
    assert (block(x, context) - block(x, context + 1)).abs().max() > 0.1


def test_unknown_conditioning():
    for make in (lambda: UNet(1, conditioning="concat"), lambda: TrainingConfig(steps=1, conditioning="concat")):
        with pytest.raises(ValueError, match="scale-shift, add, not 'concat'"):
            make()


@pytest.mark.parametrize("options", [{"blocks": 0}, {"blocks": 1.5}, {"min_snr": -1.0}, {"min_snr": "5"}])
def test_impossible_options_are_named(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        TrainingConfig(steps=1, **options)


def test_leaner_than_diffusers_at_the_same_widths():
    diffusers = pytest.importorskip("diffusers")
    theirs = diffusers.UNet2DModel(
        sample_size=28,
        in_channels=1,
        out_channels=1,
        layers_per_block=1,
        block_out_channels=(64, 128, 256),
        down_block_types=("DownBlock2D",) * 3,
        up_block_types=("UpBlock2D",) * 3,
    )
    x, t, y = inputs(1, n_conditions=1)
    flops = []
    for call in (lambda: UNet(1)(x, t, y), lambda: theirs(x, t)):
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            call()
        flops.append(counter.get_total_flops())
    assert 1.4 * flops[0] < flops[1]


def test_the_bridge_carries_detail_across():
    """With all that comes up from the coarser grids silenced, images still differ by what the skip has brought over."""
    net = shaken(channels=(8, 16, 16))
    for up in net.ups:
        up.register_forward_hook(lambda layer, given, answer: torch.zeros_like(answer))
    x, t, y = inputs()
    assert (net(x, t, y) - net(x.flip(0), t, y)).abs().max() > 0.1


@pytest.mark.parametrize("options", OPTIONS[:4])
def test_a_withheld_descriptor_is_the_null_vector(options):
    net = shaken(**options)
    x, t, y = inputs()
    without = net(x, t, None)
    torch.testing.assert_close(net(x, t, y, torch.ones(3, dtype=torch.bool)), without)
    some = net(x, t, y, torch.tensor([True, False, True]))
    torch.testing.assert_close(some[[0, 2]], without[[0, 2]])
    torch.testing.assert_close(some[1], net(x, t, y)[1])
    assert (some[1] - without[1]).abs().max() > 1e-3
    assert bool((net.context(t, None) == sinusoidal_embedding(t, 16) + net.null).all())


def test_context_is_the_sum_of_both_embeddings():
    net = shaken()
    _, t, y = inputs()
    torch.testing.assert_close(net.context(t, y), sinusoidal_embedding(t, 16) + net.descriptor(y))


def test_sinusoidal_embedding_is_that_of_the_transformer():
    """Frequencies 10,000^(−i / (d / 2)), as diffusers has them with its sines behind the cosines, and by hand."""
    t = torch.tensor([0, 1, 7, 999])
    theirs = pytest.importorskip("diffusers.models.embeddings").get_timestep_embedding(
        t, 256, flip_sin_to_cos=True, downscale_freq_shift=0
    )
    torch.testing.assert_close(sinusoidal_embedding(t, 256), theirs, rtol=0, atol=1e-4)
    angle = 7 * 10_000 ** (-3 / 8)
    assert sinusoidal_embedding(t, 16)[2, 3].item() == pytest.approx(math.cos(angle), abs=1e-6)
    assert sinusoidal_embedding(t, 16)[2, 11].item() == pytest.approx(math.sin(angle), abs=1e-6)


def test_sinusoidal_embedding_tells_every_step_apart():
    codes = sinusoidal_embedding(torch.arange(1000), 256)
    assert codes.shape == (1000, 256) and bool((codes.abs() <= 1).all())
    torch.testing.assert_close(codes.square().sum(1), torch.full((1000,), 128.0), rtol=1e-4, atol=0)
    assert torch.cdist(codes, codes).fill_diagonal_(9).min() > 0.1


def test_attention_changes_the_answer_only_after_training():
    torch.manual_seed(0)
    net = UNet(2, (8, 16), 16, 8, attention=True)
    h = torch.randn(2, 16, 7, 7)
    torch.testing.assert_close(net.attention(h), h)
    torch.nn.init.normal_(net.attention.out.weight)
    assert (net.attention(h) - h).abs().max() > 0.1


def test_attention_agrees_with_pytorchs_own():
    """`torch.nn.MultiheadAttention` with the same weights, to which the pixels are a sequence."""
    torch.manual_seed(0)
    layer, peer = (
        _Attention(8, heads=2, groups=4).double(),
        torch.nn.MultiheadAttention(8, 2, batch_first=True).double(),
    )
    torch.nn.init.normal_(layer.out.weight)
    into, out = layer.qkv, layer.out
    weights = {"in_proj_weight": into.weight.flatten(1), "out_proj.weight": out.weight.flatten(1)}
    peer.load_state_dict(weights | {"in_proj_bias": into.bias, "out_proj.bias": out.bias})
    x = torch.randn(3, 8, 4, 5).double()
    pixels = layer.norm(x).flatten(2).transpose(1, 2)
    expected = peer(pixels, pixels, pixels)[0].transpose(1, 2).reshape(x.shape)
    torch.testing.assert_close(layer(x), x + expected)


def test_rows_do_not_see_each_other():
    net = shaken()
    x, t, y = inputs()
    torch.testing.assert_close(net(x, t, y)[1:2], net(x[1:2], t[1:2], y[1:2]), rtol=1e-4, atol=1e-5)


def test_the_package_needs_torch_numpy_and_safetensors_only():
    code = (
        "import sys; before = set(sys.modules); import inflate_lib.diffusion; "
        "print(*sorted({n.split('.')[0] for n in set(sys.modules) - before} - set(sys.stdlib_module_names)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name for name in result.stdout.split() if not name.startswith("_")}
    of_torch = {"torchgen", "functorch", "tqdm", "typing_extensions"}
    assert loaded - of_torch == {"torch", "numpy", "safetensors", "inflate_lib"}


def test_parts_of_a_descriptor_are_withheld_by_nan():
    """What is not asked for has no say, all withheld is the null vector, and nothing that is asked for is ignored."""
    net = shaken(n_conditions=4, parts=[1, 3])
    x, t, y = inputs(n_conditions=4)
    nothing = torch.full_like(y, torch.nan)
    assert torch.equal(net(x, t, nothing), net(x, t, None))
    first, last = y.clone(), y.clone()
    first[:, 1:], last[:, :1] = torch.nan, torch.nan
    answers = [net(x, t, conditions) for conditions in (y, first, last, nothing)]
    for i, one in enumerate(answers):
        assert bool(torch.isfinite(one).all())
        assert all(not torch.allclose(one, other) for other in answers[:i])
    zeros = torch.zeros_like(y)
    assert not torch.allclose(net(x, t, zeros), net(x, t, nothing))  # a value of zero is not the same as none
    with pytest.raises(ValueError, match="do not make up 4"):
        shaken(n_conditions=4, parts=[1, 2])


@pytest.mark.parametrize("conditioning", CONDITIONINGS)
def test_each_block_is_told_silu_of_the_context_through_a_map_with_a_bias(conditioning):
    """The context is the sum of two embeddings; what reaches the blocks has gone through SiLU once more."""
    net, told = UNet(2, (4, 8), 16, conditioning=conditioning), []
    blocks = [module for module in net.modules() if isinstance(module, ResidualBlock)]
    for block in blocks:
        block.context.register_forward_pre_hook(lambda _, given: told.append(given[0]))
        assert block.context.bias is not None
    t, y = torch.tensor([7, 700]), torch.rand(2, 2)
    net(torch.randn(2, 1, 28, 28), t, y)
    context = sinusoidal_embedding(t, 16) + net.descriptor(y)
    assert len(told) == len(blocks) == 6
    assert all(torch.allclose(given, context * context.sigmoid()) for given in told)
