"""The networks compared with the papers: layers, shapes, receptive fields, arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from edgeperc_export.networks import ssadnet
from edgeperc_export.networks.edge import PointSegEdge, SSADNetEdge, spread
from edgeperc_export.networks.lodnn import EDGE_DILATIONS, LoDNN, LoDNNEdge
from edgeperc_export.networks.pointpillars import PointPillars
from edgeperc_export.networks.pointseg import ENLARGEMENT_RATES, Fire, FireDeconv, PointSeg, SqueezeReweight
from edgeperc_export.networks.resnets import N_BOX_VALUES, SFA3D, CENet, FIDNet, Residual
from edgeperc_export.networks.salsanext import SalsaNext
from edgeperc_export.networks.squeezesegv2 import ContextAggregation, KULSeg, SqueezeSegV2

# SSADNet, Table 1: dilation (width, height) and receptive field (width, height) of the context module's layers.
TABLE_1 = [
    ((1, 1), (3, 3)),
    ((1, 2), (5, 7)),
    ((2, 4), (9, 15)),
    ((4, 8), (17, 31)),
    ((8, 16), (33, 63)),
    ((16, 32), (65, 127)),
    ((32, 64), (129, 255)),
]


@pytest.fixture(autouse=True)
def _seed() -> Iterator[None]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def run_and_record(network: torch.nn.Module, x: torch.Tensor, *names: str) -> Any:
    """The network's outputs, and by name the inputs and outputs of some of its modules."""
    recorded = {}

    def watch(name: str) -> Callable[..., None]:
        return lambda module, inputs, output: recorded.__setitem__(name, (inputs[0], output))

    handles = [network.get_submodule(name).register_forward_hook(watch(name)) for name in names]
    with torch.no_grad():
        output = network(x)
    for handle in handles:
        handle.remove()
    return output, recorded


def on_meta(make: Callable[[], torch.nn.Module]) -> torch.nn.Module:
    """The network in inference mode, with shapes but without values (device "meta")."""
    with torch.device("meta"):
        return make().eval()


def n_parameters(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def giga_macs(network: torch.nn.Module, *shape: int) -> float:
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(torch.empty(shape, device="meta"))
    return counter.get_total_flops() / 2e9


def agree(actual: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-6)


def receptive_field(dilations: tuple[tuple[int, int], ...]) -> tuple[int, ...]:
    """Width and height that a chain of 3x3 convolutions sees."""
    return tuple(1 + 2 * sum(along) for along in zip(*dilations, strict=True))


@pytest.mark.parametrize("k", range(1, 8))
def test_the_first_k_context_layers_have_the_receptive_field_of_table_1(k: int) -> None:
    module = ssadnet.ContextModule(channels=1, width=1).eval()
    for layer in module.dilated:
        if isinstance(layer, nn.Conv2d):
            nn.init.ones_(layer.weight)
            nn.init.zeros_(layer.bias)
    x = torch.ones(1, 1, 261, 135, requires_grad=True)
    y = module.dilated[: 3 * k](x)  # convolution, dropout, ELU
    assert y.shape == x.shape
    y[0, 0, 130, 67].backward()
    rows, cols = torch.nonzero(x.grad[0, 0], as_tuple=True)
    width, height = TABLE_1[k - 1][1]
    assert receptive_field(ssadnet.CONTEXT_DILATIONS[:k]) == (width, height)
    assert (rows.min(), rows.max()) == (130 - height // 2, 130 + height // 2)
    assert (cols.min(), cols.max()) == (67 - width // 2, 67 + width // 2)
    assert len(rows) == width * height  # every cell of the field has an effect


def test_context_layers_are_dilated_farther_along_the_road() -> None:
    module = ssadnet.ContextModule()
    convolutions = [layer for layer in module.dilated if isinstance(layer, nn.Conv2d)]
    assert [conv.kernel_size for conv in convolutions] == [(3, 3)] * 7
    assert [conv.dilation for conv in convolutions] == [(height, width) for (width, height), _ in TABLE_1]
    assert [type(layer) for layer in module.dilated] == [nn.Conv2d, nn.Dropout2d, nn.ELU] * 7
    assert module.project[0].kernel_size == (1, 1)  # layer 8


def test_spatial_dropout_drops_whole_channels() -> None:
    names = [f"dilated.{3 * k + 1}" for k in range(7)]
    _, recorded = run_and_record(ssadnet.ContextModule(4, 32, dropout=0.25).train(), torch.randn(2, 4, 9, 5), *names)
    dropped = 0
    for before, after in recorded.values():
        gone = (after == 0).all((2, 3))
        agree(after, torch.where(gone[:, :, None, None], torch.zeros_like(before), before / 0.75))
        dropped += int(gone.sum())
    assert 0.15 * 448 < dropped < 0.35 * 448  # 7 x 2 x 32 channels: within five standard deviations


@pytest.mark.parametrize("shape", [(1, 1, 2, 2), (2, 3, 8, 6), (1, 4, 10, 14)])
@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_unpooling_equals_torchs(shape: tuple[int, ...], ties: bool, memory_format: torch.memory_format) -> None:
    x = torch.randint(-1, 2, shape).float() if ties else torch.randn(shape)
    x = x.to(memory_format=memory_format).requires_grad_()
    weights, scale = torch.randn(shape), torch.rand(shape[0], shape[1], shape[2] // 2, shape[3] // 2)

    pooled, mask = ssadnet.max_pool_with_mask(x)
    restored = ssadnet.max_unpool(pooled * scale, mask)
    (gradient,) = torch.autograd.grad((restored * weights).sum(), x)

    expected, indices = nn.MaxPool2d(2, return_indices=True)(x)
    expected_restored = nn.MaxUnpool2d(2)(expected * scale, indices)
    (expected_gradient,) = torch.autograd.grad((expected_restored * weights).sum(), x)

    assert mask.dtype == torch.bool
    assert torch.equal(pooled, expected)
    assert torch.equal(restored, expected_restored)
    assert torch.equal(gradient, expected_gradient)


@pytest.mark.parametrize("value", [0.0, -2.5, float("inf")])
def test_of_equal_values_the_first_is_the_maximum(value: float) -> None:
    pooled, mask = ssadnet.max_pool_with_mask(torch.full((1, 2, 4, 6), value))
    assert (pooled == value).all()
    expected = torch.zeros(4, 6, dtype=torch.bool)
    expected[::2, ::2] = True
    assert torch.equal(mask, expected.expand(1, 2, 4, 6))


@pytest.mark.parametrize("head", ["slots", "slots-paper", "dense"])
def test_ssadnet_shapes_at_each_stage(head: str) -> None:
    network = on_meta(lambda: ssadnet.SSADNet(head))
    names = [f"segmentation.{name}" for name in ("encoder", "context.dilated", "context", "decoder")]
    five = {
        "features.0": (16, 200, 100),
        "features.1": (32, 100, 50),
        "features.2": (64, 50, 25),
        "features.3": (128, 25, 12),
        "features.4": (128, 12, 6),
    }
    dense = {"fine.0": (16, 200, 100), "fine.1": (32, 100, 50), "coarse": (64, 50, 25), "merge": (64, 100, 50)}
    blocks = dense if head == "dense" else five
    x = torch.empty(2, 3, 400, 200, device="meta")
    (logits, boxes), recorded = run_and_record(network, x, *names, *(f"detection.{name}" for name in blocks))
    encoded, dilated, context, decoded = (tuple(recorded[name][1].shape) for name in names)
    assert encoded == (2, 32, 400, 200)
    assert dilated == (2, 128, 200, 100)
    assert context == (2, 32, 200, 100)
    assert decoded == (2, 32, 400, 200)
    for name, shape in blocks.items():
        assert tuple(recorded[f"detection.{name}"][1].shape) == (2, *shape)
    assert logits.shape == (2, 5, 400, 200)
    assert boxes.shape == {"slots": (2, 72, 5), "slots-paper": (2, 16, 4), "dense": (2, 9, 100, 50)}[head]


@pytest.mark.parametrize(
    ("head", "height", "width"), [("slots", 72, 40), ("slots-paper", 32, 40), ("dense", 8, 24), ("dense", 72, 40)]
)
def test_ssadnet_accepts_other_sizes(head: str, height: int, width: int) -> None:
    network = ssadnet.SSADNet(head, n_channels=2, n_classes=3, n_slots=7, context_width=4).eval()
    with torch.no_grad():
        logits, boxes = network(torch.randn(3, 2, height, width))
    assert logits.shape == (3, 3, height, width)
    slots = {"slots": (3, 2, 5), "slots-paper": (3, 7, 4)}
    assert boxes.shape == slots.get(head, (3, 9, height // 4, width // 4))
    assert logits.isfinite().all()
    assert boxes.isfinite().all()


def test_ssadnet_refuses_other_heads() -> None:
    with pytest.raises(ValueError, match="'anchors'"):
        ssadnet.SSADNet("anchors")


@pytest.mark.parametrize(("head", "detection"), [("slots", 1_036_341), ("slots-paper", 994_416), ("dense", 290_169)])
def test_parameters_and_arithmetic_of_ssadnet(head: str, detection: int) -> None:
    network = on_meta(lambda: ssadnet.SSADNet(head))
    assert n_parameters(network.segmentation) == 955_429
    assert n_parameters(network.detection) == detection
    assert n_parameters(network) == 955_429 + detection
    assert giga_macs(network, 1, 3, 400, 200) == pytest.approx(22.6, rel=0.05)


@pytest.mark.parametrize("head", ["slots", "slots-paper", "dense"])
def test_the_bridge_is_the_input_and_the_decoders_features(head: str) -> None:
    x = torch.randn(2, 3, 32, 32)
    (logits, _), recorded = run_and_record(
        ssadnet.SSADNet(head, context_width=4).eval(), x, "segmentation.decoder", "segmentation.classifier", "detection"
    )
    decoded = recorded["segmentation.decoder"][1]
    assert torch.equal(recorded["detection"][0], torch.cat([x, decoded], dim=1))
    assert torch.equal(recorded["segmentation.classifier"][0], decoded)
    assert torch.equal(recorded["segmentation.classifier"][1], logits)


def test_the_bridge_is_bfloat16_under_autocast() -> None:
    with torch.autocast("cpu", torch.bfloat16):
        _, recorded = run_and_record(
            ssadnet.SSADNet("dense", context_width=4).eval(), torch.randn(1, 3, 16, 16), "detection"
        )
    assert recorded["detection"][0].dtype == torch.bfloat16


def test_slots_by_place() -> None:
    """A slot's box starts in the middle of its square, and an object that moves by a square moves to the next slot."""
    network = ssadnet.SSADNet("slots", context_width=4, batch_norm=True).eval()
    with torch.no_grad():
        _, boxes = network(torch.zeros(1, 3, 400, 200))
    boxes = boxes[0].reshape(12, 6, 5).numpy()
    np.testing.assert_allclose(boxes[3, :, 0] * 200, 16 + 32 * np.arange(6), atol=3.0)
    np.testing.assert_allclose(boxes[:, 2, 1] * 400, 16 + 32 * np.arange(12), atol=3.0)
    np.testing.assert_allclose(boxes[..., 2:4], 0.1, rtol=0.3)
    assert (boxes[..., 4] < -2.0).all()

    head = network.detection
    for norm in (m for m in head.modules() if isinstance(m, nn.BatchNorm2d)):
        nn.init.normal_(norm.bias, std=0.1)
    x = torch.zeros(1, 35, 640, 640)
    x[..., 300:320, 300:320] = torch.randn(35, 20, 20)
    with torch.no_grad():
        before, after = (head(image).reshape(20, 20, 5) for image in (x, x.roll((32, 32), (2, 3))))
    after, before = after[5:16, 5:16], before[4:15, 4:15]  # other squares see the edge of the image
    torch.testing.assert_close(after[..., 2:], before[..., 2:])
    assert (before[..., 2:].std((0, 1)) > 1e-5).all()
    moved = after[..., :2] - before[..., :2]
    torch.testing.assert_close(moved, torch.full_like(moved, 32 / 640))


def test_slots_head_has_five_feature_blocks_and_four_regressors() -> None:
    network = ssadnet.SSADNet("slots-paper", n_slots=6, context_width=4).eval()
    blocks = [module for module in network.modules() if isinstance(module, ssadnet.FeatureBlock)]
    regressors = [module for module in network.modules() if isinstance(module, ssadnet.BoxRegressor)]
    assert len(regressors) == 4

    # Two 3x3 convolutions for each block, and one more in all blocks but the first and the last.
    layers = [[type(m) for m in block.modules() if type(m) in (nn.Conv2d, nn.BatchNorm2d, nn.ELU)] for block in blocks]
    assert layers == [[nn.Conv2d, nn.BatchNorm2d, nn.ELU] * n for n in (2, 3, 3, 3, 2)]
    kernels = {m.kernel_size for block in blocks for m in block.modules() if isinstance(m, nn.Conv2d)}
    assert kernels == {(3, 3)}

    # Each regressor is a chain of 1x1 convolutions, averaged over all pixels, and gives one of the four columns.
    names = [f"detection.regressors.{i}" for i in range(4)]
    (_, boxes), recorded = run_and_record(network, torch.randn(2, 3, 64, 96), "detection.features", *names)
    features = recorded["detection.features"][1]
    assert features.shape == (2, 128, 2, 3)
    for i, regressor in enumerate(regressors):
        assert recorded[names[i]][0] is features
        assert {m.kernel_size for m in regressor.modules() if isinstance(m, nn.Conv2d)} == {(1, 1)}
        assert type(regressor.layers[1]) is nn.ReLU
        assert sum(type(m) is nn.ELU for m in regressor.layers) == sum(type(m) is nn.Dropout for m in regressor.layers)
        agree(boxes[:, :, i], regressor.layers(features).sum((2, 3)) / 6)


def test_initial_weights_of_ssadnet_have_the_variance_that_elu_needs() -> None:
    z = np.linspace(-12.0, 12.0, 240_001)
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    elu = np.where(z > 0.0, z, np.expm1(np.minimum(z, 0.0)))
    assert 1.0 / np.sum(elu**2 * density * (z[1] - z[0])) == pytest.approx(ssadnet.ELU_GAIN, rel=1e-3)

    network = ssadnet.SSADNet("dense", dropout=0.4).train()
    for conv in (network.segmentation.encoder[1][0], network.detection.merge[0][0]):
        assert conv.weight.var().item() * conv.weight[0].numel() == pytest.approx(ssadnet.ELU_GAIN, rel=0.1)
    for conv in list(network.segmentation.context.dilated)[::3]:
        assert conv.weight.var().item() * conv.weight[0].numel() == pytest.approx(
            ssadnet.ELU_GAIN * (1.0 - 0.4), rel=0.05
        )
    with torch.no_grad():
        _, boxes = network(torch.randn(2, 3, 64, 64))
    assert boxes[:, 0].sigmoid().mean().item() == pytest.approx(ssadnet.HEAT_PRIOR, abs=0.03)


# Channels, and by how much height and width have shrunk: only the width of range images is halved.
POINTSEG_STAGES = {
    "fire1": (64, 1, 2),
    "fire3": (128, 1, 4),
    "sr1": (128, 1, 4),
    "sr2": (256, 1, 8),
    "fire7": (384, 1, 16),
    "sr3": (512, 1, 16),
    "enlarge": (128, 1, 16),
    "deconv1": (128, 1, 8),
    "deconv1_enlarged": (128, 1, 8),
    "deconv2": (128, 1, 4),
    "deconv3": (64, 1, 2),
    "deconv4": (64, 1, 1),
    "skip1": (64, 1, 1),
}
SQUEEZESEG_STAGES = {
    "fire1": (64, 1, 2),
    "context1": (64, 1, 2),
    "fire2": (128, 1, 4),
    "context2": (128, 1, 4),
    "context3": (128, 1, 4),
    "fire5": (256, 1, 8),
    "fire7": (384, 1, 16),
    "fire7b": (384, 1, 16),
    "fire9": (512, 1, 16),
    "deconv10": (256, 1, 8),
    "deconv11": (128, 1, 4),
    "deconv12": (64, 1, 2),
    "deconv13": (64, 1, 1),
    "skip1": (64, 1, 1),
}
FUSED_STAGES = {f"stages.{k}": (128, 2**k, 2**k) for k in range(4)}
SALSANEXT_STAGES = {"context": (32, 1, 1), "encoders.0": (64, 1, 1), "encoders.4": (256, 16, 16)}
SALSANEXT_STAGES |= {"decoders.0": (128, 8, 8)}
LEVELS = {f"heads.0.levels.{k}": stage for k, stage in enumerate(((256, 8, 8), (128, 4, 4), (64, 4, 4)))}
PILLAR_STAGES = {"blocks.2": (256, 8, 8), "ups.2": (128, 2, 2)}
ANCHORS, HEADS = [(n, 2, 2) for n in (2, 14, 4)], [(n, 4, 4) for n in N_BOX_VALUES.values()]
RANGE_IMAGES, RIVALS_IMAGES = [(64, 512), (64, 2048)], [(64, 2048), (64, 512), (40, 90)]


def shrunk(size: tuple[int, int], channels: int, down: int, across: int) -> tuple[int, ...]:
    """The shape of a stage for two images of a size; odd ones are halved upwards."""
    return 2, channels, -(-size[0] // down), -(-size[1] // across)


@pytest.mark.parametrize(
    ("make", "n_channels", "sizes", "gets", "gives", "answers"),
    [
        (PointSeg, 5, RANGE_IMAGES, {"enlarge": (512, 1, 16)}, POINTSEG_STAGES, [(4, 1, 1)]),
        (SqueezeSegV2, 5, RANGE_IMAGES, {}, SQUEEZESEG_STAGES, [(4, 1, 1)]),
        (KULSeg, 5, RANGE_IMAGES, {}, SQUEEZESEG_STAGES, [(4, 1, 1)]),
        (SalsaNext, 5, [(64, 2048), (64, 512), (32, 1024), (16, 16)], {}, SALSANEXT_STAGES, [(20, 1, 1)]),
        # Five resolutions are fused.
        (FIDNet, 5, RIVALS_IMAGES, {"head": (1024, 1, 1)}, FUSED_STAGES | {"stem": (512, 1, 1)}, [(20, 1, 1)]),
        (CENet, 5, RIVALS_IMAGES, {"head": (640, 1, 1)}, FUSED_STAGES | {"stem": (128, 1, 1)}, [(20, 1, 1)]),
        # Two anchors at half the resolution, five heads at a quarter of it
        (PointPillars, 64, [(496, 432), (248, 216), (8, 16)], {}, PILLAR_STAGES, ANCHORS),
        (SFA3D, 3, [(608, 608), (64, 96), (32, 32)], LEVELS, {"stages.3": (512, 32, 32)}, HEADS),
    ],
)
def test_stages_and_answers_have_the_described_shapes(
    make: Callable[[], torch.nn.Module],
    n_channels: int,
    sizes: list[tuple[int, int]],
    gets: dict[str, tuple[int, int, int]],
    gives: dict[str, tuple[int, int, int]],
    answers: list[tuple[int, int, int]],
) -> None:
    network = on_meta(make)
    for size in sizes:
        found, recorded = run_and_record(network, torch.empty(2, n_channels, *size, device="meta"), *gets, *gives)
        for k, stages in enumerate((gets, gives)):
            for name, stage in stages.items():
                assert tuple(recorded[name][k].shape) == shrunk(size, *stage), name
        found = [found] if torch.is_tensor(found) else found
        assert [tuple(answer.shape) for answer in found] == [shrunk(size, *answer) for answer in answers]


@pytest.mark.parametrize(("make", "n", "width"), [(PointSeg, 4, 256), (KULSeg, 3, 128)])
def test_networks_of_range_images_accept_other_sizes(make: Callable[..., torch.nn.Module], n: int, width: int) -> None:
    for size in ((32, width), (5, 16)):
        with torch.inference_mode():
            logits = make(n_classes=n).eval()(torch.randn(2, 5, *size))
        assert logits.shape == (2, n, *size)
        assert logits.isfinite().all()


def test_fire_layers_squeeze_to_a_quarter() -> None:
    layers = {name: m for name, m in PointSeg().named_modules() if isinstance(m, Fire)}
    assert [name for name, m in layers.items() if type(m) is Fire] == [f"fire{i}" for i in range(2, 10)]
    assert sum(isinstance(m, FireDeconv) for m in layers.values()) == 5
    for layer in layers.values():
        squeeze, expand1, expand3 = layer.squeeze[0], layer.expand1[0], layer.expand3[0]
        assert squeeze.out_channels == squeeze.in_channels // 4 == expand1.in_channels == expand3.in_channels
        assert (squeeze.kernel_size, expand1.kernel_size, expand3.kernel_size) == ((1, 1), (1, 1), (3, 3))
        assert expand1.out_channels == expand3.out_channels


def test_squeeze_reweighting_is_equations_3_and_4() -> None:
    layer = SqueezeReweight(8)
    x = torch.randn(3, 8, 5, 7)
    with torch.no_grad():
        actual = layer(x).numpy()
        w1, b1, w2, b2 = (parameter.squeeze().double().numpy() for parameter in layer.parameters())
    p = x.double().numpy()
    assert w1.shape == (2, 8)
    for sample, y in zip(p, actual, strict=True):
        chi = np.array([sample[n].sum() / (5 * 7) for n in range(8)])  # equation 3
        scale = 1.0 / (1.0 + np.exp(-(w2 @ np.maximum(w1 @ chi + b1, 0.0) + b2)))
        np.testing.assert_allclose(y, sample * scale[:, None, None], rtol=1e-5)  # equation 4


def test_enlargement_has_five_scales() -> None:
    network = PointSeg().eval()
    nn.init.ones_(network.enlarge.average[0].bias)
    names = ["point", "dilated.0", "dilated.1", "dilated.2", "average"]
    x = torch.randn(2, 512, 8, 6)
    _, recorded = run_and_record(network.enlarge, x, *names, "compress")
    rates = [conv[0].dilation for conv in network.enlarge.dilated]
    assert list(ENLARGEMENT_RATES) == [6, 9, 12]
    assert rates == [(6, 6), (9, 9), (12, 12)]
    assert [conv[0].kernel_size for conv in network.enlarge.dilated] == [(3, 3)] * 3
    branches = [recorded[name][1].expand(2, 80, 8, 6) for name in names]
    assert recorded["average"][1].shape == (2, 80, 1, 1)
    agree(recorded["average"][0].squeeze(), x.sum((2, 3)) / 48)
    assert recorded["average"][1].std() > 0.0
    assert torch.equal(recorded["compress"][0], torch.cat(branches, dim=1))
    assert recorded["compress"][1].shape == (2, 512 // 4, 8, 6)


def test_pointseg_adds_skips_and_concatenates_only_the_enlarged() -> None:
    names = ["fire1", "skip1", "sr1", "sr2", "sr3", "enlarge", "deconv1", "deconv1_enlarged"]
    names += ["deconv2", "deconv3", "deconv4", "classifier"]
    logits, recorded = run_and_record(PointSeg().eval(), torch.randn(1, 5, 4, 64), *names)
    got, gave = ({name: pair[i] for name, pair in recorded.items()} for i in (0, 1))
    assert torch.equal(got["enlarge"], gave["sr3"])
    assert torch.equal(got["deconv1"], gave["sr3"])
    assert torch.equal(got["deconv1_enlarged"], gave["enlarge"])
    agree(got["deconv2"], torch.cat([gave["deconv1_enlarged"], gave["deconv1"]], dim=1) + gave["sr2"])
    agree(got["deconv3"], gave["deconv2"] + gave["sr1"])
    agree(got["deconv4"], gave["deconv3"] + gave["fire1"])
    agree(got["classifier"], gave["deconv4"] + gave["skip1"])
    assert torch.equal(gave["classifier"], logits)


def test_kulseg_is_squeezesegv2_with_a_fire_7b() -> None:
    kulseg, plain = on_meta(KULSeg).state_dict(), on_meta(SqueezeSegV2).state_dict()
    shape_of = {name: value.shape for name, value in kulseg.items()}
    added = {name: shape for name, shape in shape_of.items() if name.startswith("fire7b.")}
    assert {name: value.shape for name, value in plain.items()} == {n: s for n, s in shape_of.items() if n not in added}
    fire7 = {name: shape for name, shape in shape_of.items() if name.startswith("fire7.")}
    assert {name.replace("fire7b.", "fire7."): shape for name, shape in added.items()} == fire7

    x = torch.randn(1, 5, 4, 32)
    _, recorded = run_and_record(KULSeg().eval(), x, "fire7", "fire7b", "fire8")
    assert recorded["fire7b"][0] is recorded["fire7"][1]
    assert recorded["fire8"][0] is recorded["fire7b"][1]
    assert not torch.equal(recorded["fire7b"][1], recorded["fire7"][1])
    _, recorded = run_and_record(SqueezeSegV2().eval(), x, "fire7", "fire8")
    assert recorded["fire8"][0] is recorded["fire7"][1]


def test_squeezesegv2_squeezes_as_squeezeseg_does() -> None:
    layers = {name: m for name, m in KULSeg().named_modules() if isinstance(m, Fire)}
    widths = {
        "fire2": (64, 16, 128),
        "fire3": (128, 16, 128),
        "fire4": (128, 32, 256),
        "fire5": (256, 32, 256),
        "fire6": (256, 48, 384),
        "fire7": (384, 48, 384),
        "fire8": (384, 64, 512),
        "fire9": (512, 64, 512),
        "deconv10": (512, 64, 256),
        "deconv11": (256, 32, 128),
        "deconv12": (128, 16, 64),
        "deconv13": (64, 16, 64),
        "fire7b": (384, 48, 384),
    }
    assert {
        name: (m.squeeze[0].in_channels, m.squeeze[0].out_channels, m.expand1[0].out_channels * 2)
        for name, m in layers.items()
    } == widths


def test_context_aggregation_scales_by_the_maximum_around() -> None:
    layer = ContextAggregation(32)
    x = torch.randn(2, 32, 9, 11)
    with torch.no_grad():
        actual = layer(x).numpy()
        w1, b1, w2, b2 = (parameter.squeeze().double().numpy() for parameter in layer.parameters())
    assert w1.shape == (2, 32)  # a sixteenth
    for sample, y in zip(x.double().numpy(), actual, strict=True):
        for row, col in np.ndindex(9, 11):
            around = sample[:, max(row - 3, 0) : row + 4, max(col - 3, 0) : col + 4].max((1, 2))
            scale = 1.0 / (1.0 + np.exp(-(w2 @ np.maximum(w1 @ around + b1, 0.0) + b2)))
            np.testing.assert_allclose(y[:, row, col], sample[:, row, col] * scale, rtol=1e-4, atol=1e-6)


def test_context_aggregation_sees_7_by_7() -> None:
    layer = ContextAggregation(16)
    for parameter in layer.parameters():
        nn.init.constant_(parameter, 0.1)
    flat = torch.ones(1, 16, 15, 17)
    peaked = flat.clone()
    peaked[0, 0, 7, 8] = 3.0
    with torch.no_grad():
        rows, cols = torch.nonzero((layer(peaked) - layer(flat))[0, 1], as_tuple=True)
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (4, 10, 5, 11)
    assert len(rows) == 49


def test_squeezesegv2_gets_the_mask_of_returns() -> None:
    x = torch.randn(2, 5, 4, 32)
    x[0, :, 1, 3:9] = 0.0
    x[1, 1:, 2, 5] = 0.0  # also a return: its x is not 0
    _, recorded = run_and_record(SqueezeSegV2().eval(), x, "fire1", "skip1")
    for name in ("fire1", "skip1"):
        assert torch.equal(recorded[name][0][:, :5], x)
        expected = torch.ones(2, 4, 32)
        expected[0, 1, 3:9] = 0.0
        assert torch.equal(recorded[name][0][:, 5], expected)


def test_squeezesegv2_aggregates_context_three_times_and_adds_its_skips() -> None:
    names = [f"context{i}" for i in (1, 2, 3)] + [f"deconv{i}" for i in (10, 11, 12, 13)]
    names += ["skip1", "fire1", "fire2", "fire3", "fire4", "fire5", "fire9", "classifier"]
    logits, recorded = run_and_record(KULSeg().eval(), torch.randn(1, 5, 4, 64), *names)
    got, gave = ({name: pair[i] for name, pair in recorded.items()} for i in (0, 1))
    assert torch.equal(got["context1"], gave["fire1"])
    agree(got["fire2"], nn.functional.max_pool2d(gave["context1"], 3, stride=(1, 2), padding=1))
    assert torch.equal(got["context2"], gave["fire2"])
    assert torch.equal(got["fire3"], gave["context2"])
    assert torch.equal(got["context3"], gave["fire3"])
    agree(got["fire4"], nn.functional.max_pool2d(gave["context3"], 3, stride=(1, 2), padding=1))
    assert torch.equal(got["deconv10"], gave["fire9"])
    agree(got["deconv11"], gave["deconv10"] + gave["fire5"])
    agree(got["deconv12"], gave["deconv11"] + gave["context3"])
    agree(got["deconv13"], gave["deconv12"] + gave["context1"])
    agree(got["classifier"], gave["deconv13"] + gave["skip1"])
    assert torch.equal(gave["classifier"], logits)


@pytest.mark.parametrize(
    ("network", "channels", "sizes"),
    [(PointSegEdge, 5, [(64, 512), (32, 256), (4, 8)]), (SSADNetEdge, 3, [(400, 200), (8, 16)])],
)
def test_edge_networks_have_the_outputs_of_the_full_ones(
    network: Callable[..., torch.nn.Module], channels: int, sizes: list[tuple[int, int]]
) -> None:
    edge = network().eval()
    full = PointSeg().eval() if network is PointSegEdge else ssadnet.SSADNet("dense", context_width=64).eval()
    for height, width in sizes:
        x = torch.rand(1, channels, height, width)
        with torch.no_grad():
            answers = edge(x)
            if network is PointSegEdge:
                assert answers.shape == (1, 4, height, width)
            else:
                assert [tuple(a.shape) for a in answers] == [(1, 5, height, width), (1, 9, height // 4, width // 4)]
    costs = [giga_macs(each.to("meta"), 1, channels, *sizes[0]) for each in (edge, full)]
    assert costs[0] == pytest.approx(1.02 if network is PointSegEdge else 1.44, abs=0.02)
    assert costs[0] < costs[1] / 5.5


@pytest.mark.parametrize("block", [(1, 2), (2, 2), (2, 3)])
def test_spreading_moves_channels_to_pixels(block: tuple[int, int]) -> None:
    rows, cols = block
    x = torch.rand(2, 3 * rows * cols, 4, 5)
    out = spread(x, block)
    assert out.shape == (2, 3, 4 * rows, 5 * cols)
    for row in range(rows):
        for col in range(cols):
            assert torch.equal(out[:, :, row::rows, col::cols], x[:, row * cols + col :: rows * cols])


@pytest.mark.parametrize(("n_channels", "n_expected"), [(6, 947_458), (3, 946_594)])
def test_lodnn_has_the_papers_layers(n_channels: int, n_expected: int) -> None:
    """LoDNN, Table 1. SSADNet has the same context module: 128 channels, 32 in its 1x1; 32 before and after it."""
    network = on_meta(lambda: LoDNN(n_channels=n_channels))
    convolutions = [m for m in network.modules() if isinstance(m, nn.Conv2d)]
    channels = [n_channels, 32, 32, *[128] * 7, 32, 32, 2]
    assert [(conv.in_channels, conv.out_channels) for conv in convolutions] == [*pairwise(channels)]
    dilations = [(1, 1)] * 2 + [dilation for dilation, _ in TABLE_1] + [(1, 1)] * 3
    assert [conv.dilation[::-1] for conv in convolutions] == dilations
    assert [conv.kernel_size for conv in convolutions] == [(3, 3)] * 9 + [(1, 1)] + [(3, 3)] * 2
    kernels = [3] * 9 + [1] + [3] * 2
    by_hand = sum((k * k * a + 1) * b for (a, b), k in zip(pairwise(channels), kernels, strict=True))
    assert n_parameters(network) == by_hand == n_expected


def test_lodnn_halves_the_resolution_once() -> None:
    names = ["encoder", "context.dilated", "context", "decoder"]
    logits, recorded = run_and_record(LoDNN(context_width=8).eval(), torch.randn(1, 3, 400, 200), *names)
    assert logits.shape == (1, 2, 400, 200)
    shapes = {name: (tuple(given.shape[1:]), tuple(made.shape[1:])) for name, (given, made) in recorded.items()}
    assert shapes == {
        "encoder": ((3, 400, 200), (32, 400, 200)),
        "context.dilated": ((32, 200, 100), (8, 200, 100)),
        "context": ((32, 200, 100), (32, 200, 100)),
        "decoder": ((32, 400, 200), (32, 400, 200)),
    }
    assert (recorded["decoder"][0] != 0).float().mean() <= 0.25  # unpooled: a cell of four


def test_lodnn_keeps_the_signal_and_learns_from_random_weights() -> None:
    network = LoDNN(context_width=32).eval()
    _, recorded = run_and_record(
        network, torch.randn(1, 3, 200, 100), *(f"context.dilated.{k}" for k in range(2, 21, 3))
    )
    sizes = [float(made.pow(2).mean().sqrt()) for _, made in recorded.values()]
    assert all(0.2 < size < 3.0 for size in sizes)


def test_lodnn_edge_has_the_receptive_field_of_lodnn_at_a_27th_of_the_arithmetic() -> None:
    network = on_meta(LoDNNEdge)
    cells, whole = receptive_field(EDGE_DILATIONS), receptive_field(ssadnet.CONTEXT_DILATIONS)
    assert [0.4 * n for n in cells] == pytest.approx([0.2 * n for n in whole], abs=0.3)  # meters
    shape = (1, 3, 400, 200)
    assert network(torch.empty(shape, device="meta")).shape == (1, 2, 400, 200)
    small, full = giga_macs(network, *shape), giga_macs(on_meta(LoDNN), *shape)
    assert 27 < full / small < 28
    assert small < 0.6 * giga_macs(on_meta(SSADNetEdge), *shape)
    dilations = [block.conv.dilation for block in network.context]
    assert dilations == [(height, width) for width, height in EDGE_DILATIONS]


def test_lodnn_edge_is_a_shortcut_before_training() -> None:
    network = LoDNNEdge().eval()
    x = torch.rand(1, 48, 20, 10)
    agree(network.context(x), x)
    logits, _ = run_and_record(network, torch.rand(1, 3, 40, 20))
    assert logits.abs().max() < 1.0


# networks that are only measured against


@pytest.mark.parametrize(("c_in", "c_out", "stride"), [(8, 8, 1), (8, 4, 1), (8, 8, 2), (4, 16, 2)])
def test_a_residual_block_adds_its_input(c_in: int, c_out: int, stride: int) -> None:
    block, x = Residual(c_in, c_out, stride, nn.ReLU).eval(), torch.randn(2, c_in, 7, 9)
    nn.init.zeros_(block.layers[-1].weight)  # of the last batch norm
    with torch.no_grad():
        agree(block(x), block.shortcut(x).relu())
    assert (len(block.shortcut) == 0) == (c_in == c_out and stride == 1)


@pytest.mark.parametrize("size", [32, 64, 96])
def test_sfa3d_weights_its_levels_by_their_softmax(size: int) -> None:
    names = [f"heads.0.levels.{k}" for k in range(3)]
    (heat, *_), recorded = run_and_record(SFA3D().eval(), torch.randn(1, 3, size, size), *names)
    coarse, *finer = (recorded[name][1] for name in names)
    levels = torch.stack([coarse.repeat_interleave(2, 2).repeat_interleave(2, 3), *finer])
    agree(heat, (levels * levels.exp()).sum(0) / levels.exp().sum(0))


@pytest.mark.parametrize(
    ("make", "shape", "parameters", "gmac", "published"),
    [
        (PointSeg, (1, 5, 64, 512), 2_983_700, pytest.approx(7.3, rel=0.05), None),
        (SqueezeSegV2, (1, 5, 64, 512), 915_672, pytest.approx(2.959, abs=0.001), None),
        (KULSeg, (1, 5, 64, 512), 1_027_128, pytest.approx(3.186, abs=0.001), None),
        # The paper: 62.84 G.
        (SalsaNext, (1, 5, 64, 2048), 6_711_572, pytest.approx(62.298, abs=0.001), pytest.approx(6.73, abs=0.02)),
        (PointPillars, (1, 64, 496, 432), 4_814_100, pytest.approx(33.104, abs=0.001), None),
        (FIDNet, (1, 5, 64, 2048), 6_052_820, pytest.approx(338.438, abs=0.001), pytest.approx(6.05, abs=0.005)),
        (CENet, (1, 5, 64, 2048), 6_774_228, pytest.approx(433.263, abs=0.001), pytest.approx(6.8, abs=0.05)),
        (SFA3D, (1, 3, 608, 608), 12_728_353, pytest.approx(31.284, abs=0.001), pytest.approx(13.0, abs=0.5)),
    ],
)
def test_parameters_and_arithmetic(
    make: Callable[[], torch.nn.Module], shape: tuple[int, ...], parameters: int, gmac: Any, published: Any
) -> None:
    """``published``: millions of parameters of a rival, in its paper."""
    network = on_meta(make)
    assert n_parameters(network) == parameters
    assert published is None or parameters / 1e6 == published
    assert giga_macs(network, *shape) == gmac
    if make is PointSeg:
        assert n_parameters(network.enlarge) == 1_240_016
    elif make in (SqueezeSegV2, KULSeg):
        assert giga_macs(network, *shape) < 0.45 * giga_macs(on_meta(PointSeg), *shape)


def test_the_trunk_of_sfa3d_is_resnet_18() -> None:
    network = on_meta(SFA3D)
    assert n_parameters(network.stem) + n_parameters(network.stages) == 11_689_512 - 513_000  # without its classifier
    trunk = giga_macs(nn.Sequential(network.stem, *network.stages), 1, 3, 224, 224)
    assert trunk == pytest.approx(1.81, abs=0.005)  # as torchvision has it
