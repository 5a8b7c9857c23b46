"""How a network is trained: recipes, and the runs that make the shipped models. Importing this loads no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from edgeperc.types.choices import STATIC

TASKS: Mapping[str, tuple[str, ...]] = {
    "points": ("kulseg", "pointseg", "squeezesegv2"),
    "vehicles": ("ssadnet",),
    "road": ("lodnn",),
    "objects": ("objects",),
    "camera": ("camseg", "fcn16", "fcn8", "segnet", "unet", "unet-long", "unet-small", "unet-small-leaky"),
}
"""Task -> its networks. Points: a class for every point of a range image. Vehicles: vehicles and drivable area in a
top view. Road: drivable area alone. Objects: class and box of each candidate. Camera: a class for every pixel of a
camera's image."""

NETWORKS = tuple(sorted(network for networks in TASKS.values() for network in networks))
SCAN_NETWORKS = tuple(network for task in ("points", "vehicles", "road") for network in TASKS[task])
"""Networks of whole LiDAR scans."""
EDGE_NETWORKS = ("lodnn", "pointseg", "ssadnet")
"""Networks with a version for small computers (`edgeperc_export.networks.edge`)."""
EDGE_BLOCKS: Mapping[str, tuple[int, int]] = {"pointseg": (2, 4), "ssadnet": (4, 4)}
"""Rows and columns of the blocks of pixels that they label at once."""

# Smallest and largest value of the numbers of a recipe; that of others is any from 0.
LIMITS: Mapping[str, tuple[float, float]] = {
    **dict.fromkeys(("steps", "batch", "accumulate", "reuse", "image_width", "image_height"), (1, math.inf)),
    **dict.fromkeys(("cooldown", "simulated_share", "swap", "paste_cars", "turn_to_rare", "turn_anywhere"), (0, 1)),
    **dict.fromkeys(("weather", "beams", "no_remission", "ema", "kept", "found_again"), (0, 1)),
    **{
        "context_width": (1, 4096),
        "dropout": (0, 0.999),
        "width": (1e-3, 8),
        "runs": (1, 1000),
        "seed": (0, 2**31 - 1),
    },
}


def _option(
    default: Any, text: str, networks: tuple[str, ...] = NETWORKS, *, edge: bool = True, choices: tuple[str, ...] = ()
) -> Any:
    """A field that is an option of ``train`` for these networks; ``edge``: for their small versions too."""
    return field(default=default, metadata={"help": text, "networks": networks, "edge": edge, "choices": choices})


_points, _vehicles, _camera = (partial(_option, networks=TASKS[task]) for task in ("points", "vehicles", "camera"))
_scans, _top_view = (partial(_option, networks=of) for of in (SCAN_NETWORKS, (*TASKS["vehicles"], *TASKS["road"])))


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a training run except the scans.

    The metadata of each field holds its description (``help``) and the networks that it has an effect on
    (``networks``; ``edge``: on their versions for small computers too). ``edgeperc-export train NETWORK --help``
    prints them.
    """

    network: str
    head: str = _vehicles(
        "dense",
        "box head: dense (one prediction every four cells), slots (SSADNet's own: a fixed number of upright boxes, "
        "here one for each square of 3.2 m) or slots-paper (as published: nearest first, averaged over the image)",
        edge=False,
        choices=("dense", "slots", "slots-paper"),
    )
    front: bool = _vehicles(
        False, "the box head also predicts which end of a vehicle is its front; only with head dense"
    )
    height_above_ground: bool = _points(False, "the input has a channel with the height of each point above the ground")
    curvature: bool = _points(
        False, "the input has the height above the ground, and a channel with how much the range bends along a row"
    )
    classes: tuple[str, ...] = _points(
        (), "classes of points, the background first, separated by commas; empty: those of edgeperc"
    )
    steps: int = _option(2000, "training steps")
    batch: int = _option(8, "scans, or images, in each step")
    accumulate: int = _option(
        1, "number of parts of a batch whose gradients are added up, for a batch that does not fit into memory"
    )
    reuse: int = _scans(
        1,
        "how often each sample is used; the later times are drawn from the newest samples. For a GPU that trains "
        "faster than samples are made. Above 1, a resumed run differs from an uninterrupted one",
    )
    optimizer: str = _option("adamw", "optimizer", choices=("adamw", "adam", "adagrad"))
    learning_rate: float = _option(
        2e-3, "highest learning rate; it warms up over 100 steps, stays constant and follows a cosine to zero"
    )
    weight_decay: float = _option(1e-3, "AdamW's weight decay of convolution weights")
    cooldown: float = _option(
        0.4,
        "share of the steps in which the learning rate falls to zero; 0: constant from the first step. Until it "
        "begins, a longer run equals a shorter one",
    )
    halve_after: int = _scans(
        0, "halve the learning rate after this many epochs without a lower validation loss (SSADNet 3.2); 0: never"
    )
    stop_after: int = _camera(
        0, "stop after this many epochs without a better validation figure, and keep the best weights; 0: never"
    )
    image_width: int = _camera(480, "columns that images are scaled to")
    image_height: int = _camera(360, "rows that images are scaled to")
    simulated_share: float = _scans(0.5, "share of simulated scans; the rest are real. 1: no real scan is read")
    augment: bool = _option(
        True, "turn, mirror, thin and shift every scan; scale, crop, mirror and recolor every image"
    )
    n_pasted: float = _scans(6.0, "mean number of objects cut from other scans and pasted into each scan")
    swap: float = _points(0.3, "share of scans that get one sector of another scan")
    paste_cars: float = _points(0.0, "share of cars among pasted objects; 0: cars are not pasted into range images")
    n_negatives: float = _scans(
        2.0, "mean number of poles, trunks and pieces of walls that are cut from other scans and pasted into each scan"
    )
    turn_to_rare: float = _scans(0.3, "share of simulated scans turned so that a pedestrian or cyclist is ahead")
    turn_anywhere: float = _scans(
        0.0, "share of simulated scans turned by any angle, so that vehicles appear away from the street ahead"
    )
    weather: float = _scans(0.1, "share of scans with rain, snow or fog added")
    beams: float = _scans(
        0.1,
        "share of scans of the training sensor that are thinned to the beams and columns of another one, drawn at "
        "random: a known one, one with 12 to 48 beams, or one without beams",
    )
    sparse: bool = _points(
        False,
        "the other sensors have few beams or none, and scans of every dense sensor are thinned, too (with --beams)",
    )
    tilt_deg: float = _scans(
        0.25, "standard deviation of the roll and pitch by which scans are tilted [deg]: errors of the leveling"
    )
    no_remission: float = _scans(
        0.05, "share of scans whose remission is the constant that stands for a missing one at run time"
    )
    range_noise_m: float = _points(
        0.0, "half of the scans get noise along the rays, of a standard deviation of up to this many meters"
    )
    redraw_every: int = _scans(
        1000, "after this many steps, label some training scans and draw those with false objects more often; 0: never"
    )
    class_weights: bool = _option(
        True, "weight rare classes more in the cross-entropy", (*TASKS["points"], *TASKS["vehicles"], *TASKS["camera"])
    )
    focal_gamma: float = _points(0.0, "focal loss exponent of the cross-entropy; 0: plain cross-entropy")
    lovasz_weight: float = _option(1.0, "weight of the Lovasz-softmax loss, added to the cross-entropy")
    deep_supervision: float = _option(
        0.0, "weight of additional losses of early logits", ("camseg", "pointseg"), edge=False
    )
    ema: float = _option(
        0.998, "decay of the averaged weights, which are the ones exported; 0: export the last weights"
    )
    kept: float = _option(
        0.0,
        "share of the weights of --start-from in the exported ones, which are then a mean of both: what the network "
        "was good at is kept (WiSE-FT; Wortsman et al., 2022)",
        (*SCAN_NETWORKS, *TASKS["objects"]),
    )
    context_width: int = _top_view(128, "channels of the context module", edge=False)
    batch_norm: bool = _top_view(
        True, "batch norm in the segmentation branch (ssadnet) or the whole network (lodnn)", edge=False
    )
    dropout: float = _option(0.25, "dropout probability", edge=False)
    distil: float = _scans(
        0.0, "weight of the distillation loss (Hinton et al., 2015) towards --teacher's outputs; 0: no distillation"
    )
    seen_twice: bool = _scans(
        True, "average the teacher's outputs over each scan and its mirror image; doubles the teacher's time"
    )
    edge: bool = _option(
        False, "train the network's version for small computers, with the same inputs and outputs", EDGE_NETWORKS
    )
    width: float = _option(
        1.0, "factor of the channels of a network for small computers (with --edge)", ("pointseg", "ssadnet")
    )
    head_only: bool = _vehicles(
        False, "train only the box head and keep the segmentation branch from --start-from", edge=False
    )
    drawn_roads: bool = _top_view(False, "use the hand-drawn roads as ground truth where a training scan has one")
    detector: bool = _option(
        True, "boxes of ssadnet, a network that was trained on KITTI, are candidates in training too", TASKS["objects"]
    )
    found_again: float = _option(
        0.0,
        "share of the candidates that are boxes which the network itself finds, as at its second look",
        TASKS["objects"],
    )
    thinned: bool = _option(
        False, "real scans as sensors of few beams, or without beams, take them are trained on, too", TASKS["objects"]
    )
    runs: int = _option(
        1,
        "runs, with one seed after the other; the mean of their weights is exported, which holds less of what chance "
        "gave each (model soup; Wortsman et al., 2022)",
        TASKS["objects"],
    )
    seed: int = _option(0, "seed of the initial weights, the samples and the dropout")

    @property
    def task(self) -> str:
        """The key of `TASKS` that the network belongs to."""
        for task, networks in TASKS.items():
            if self.network in networks:
                return task
        raise ValueError(f"network is {self.network!r}; expected {', '.join(NETWORKS[:-1])} or {NETWORKS[-1]}")

    def check(self) -> None:
        """Raise ValueError for a number that no run can be made with."""
        for name, value in vars(self).items():
            low, high = LIMITS.get(name, (0, math.inf))
            if isinstance(value, int | float) and not (low <= value <= high and value < math.inf):
                most = f" to {high}" if high < math.inf else " or more"
                raise ValueError(f"--{name.replace('_', '-')} is {value}; expected {low}{most}")
        if self.network == "camseg" and (self.image_width % 4 or self.image_height % 4):  # it could not be exported
            raise ValueError(
                f"images are scaled to {self.image_width} x {self.image_height} pixels, and camseg labels every "
                "fourth; expected multiples of 4 as --image-width and --image-height"
            )


PLAIN: Mapping[str, Any] = {
    **dict.fromkeys(("augment", "class_weights", "batch_norm"), False),
    **dict.fromkeys(("simulated_share", "n_pasted", "swap", "n_negatives", "turn_to_rare", "weather", "beams"), 0.0),
    **dict.fromkeys(("tilt_deg", "no_remission", "lovasz_weight", "weight_decay", "cooldown", "ema"), 0.0),
    "redraw_every": 0,
}
"""Settings that switch off everything that the papers do not mention."""

PAPER = {
    # SSADNet 3.2: Adam, 1e-5, halved after 100 epochs without improvement; batch 8; cross-entropy and 0.1 x MSE.
    "ssadnet": Recipe(
        "ssadnet", head="slots-paper", optimizer="adam", learning_rate=1e-5, halve_after=100, steps=65_000, **PLAIN
    ),
    # PointSeg 5: Adagrad, 1e-3, batch 32, 50,000 steps.
    "pointseg": Recipe("pointseg", optimizer="adagrad", learning_rate=1e-3, batch=32, steps=50_000, **PLAIN),
    # LoDNN-I (Electronics 12, 3165) 3.3 to 3.6: cross-entropy on drawn roads, augmented; 22 epochs; the learning rate
    # is lowered when the validation figure stops improving. The paper prints the rate as "1 x 10^-x" and the batch size
    # as the largest tried; here they are Adam's default rate and 16. 22 epochs of 300 scenes, each in eight variations,
    # are 3,300 steps of 16. The authors drew 300 scenes. Here nine are drawn; the other scans have the ground truth of
    # `roads.sure_surface`.
    "lodnn": Recipe(
        "lodnn",
        optimizer="adam",
        learning_rate=1e-3,
        halve_after=1,
        batch=16,
        steps=3_300,
        drawn_roads=True,
        **{**PLAIN, "augment": True},
    ),
    # Jebamikyous (2021), section 3.1: Adam, categorical cross-entropy, batch 32, at most 100 epochs (1,147 steps of the
    # 367 images), stopped after ten without a better validation figure. Images divided by 255 (`cards`). The learning
    # rate is not stated; here it is 3e-4.
    **{
        network: Recipe(
            network,
            optimizer="adam",
            learning_rate=3e-4,
            batch=32,
            accumulate=8,
            steps=1_147,
            stop_after=10,
            **{**PLAIN, "dropout": 0.0},
        )
        for network in TASKS["camera"]
        if network != "camseg"
    },
}
"""The papers' own recipes, without what the papers do not mention (`PLAIN`)."""


@dataclass(frozen=True)
class Stage:
    """One training run on the way to a model."""

    # with a ``simulated_share`` of 1 the run reads no real scan and no real layout, so no data license applies
    recipe: Recipe
    is_open: bool = False  # no scan and no layout of KITTI is read, so that anyone may use the weights
    after: str | None = None  # the model whose weights the run starts from
    teacher: str | None = None  # the model that the run is distilled from
    also: tuple[str, ...] = ()  # more simulated scans: of other sensors, in halls (`make.MORE_SCANS`)


# From random weights, distilled from the first step; the focal loss is SqueezeSegV2's.
KULSEG = Recipe("kulseg", steps=3600, batch=4, focal_gamma=2.0, distil=1.0, seen_twice=False)

# Batches of four instead of eight: twice the steps for the same number of scans, and better figures. No dropout: with
# so few training scans the network does not need it, and it disturbs batch norm.
SSADNET = Recipe("ssadnet", batch=4, learning_rate=1.5e-3, context_width=64, n_pasted=3.0, dropout=0.0)

# Each sample is used six times on a GPU, which trains faster than samples are made: 256,000 samples in nine minutes.
EDGE = Recipe(
    "pointseg",
    edge=True,
    height_above_ground=True,
    steps=8000,
    batch=32,
    reuse=6,
    learning_rate=3e-3,
    ema=0.999,
    turn_anywhere=0.3,
    redraw_every=4000,
)

# Continued with scans as other sensors take them, whose range images are filled between the beams as at run time.
BEAMS = replace(
    EDGE,
    beams=0.6,
    kept=0.7,
    steps=1700,
    batch=8,
    reuse=2,
    learning_rate=1.2e-3,
    cooldown=0.9,
    ema=0.995,
    redraw_every=0,
)

# For sensors of few beams, or without beams, whose range images are mostly filled: all scans are as these take them.
SPARSE = replace(BEAMS, beams=1.0, sparse=True, kept=0.5, steps=5500, batch=16, ema=0.998)

# LoDNN-I's structure at a quarter of the resolution, distilled from the start from the network with the best roads.
LODNN = Recipe(
    "lodnn",
    edge=True,
    steps=4500,
    batch=4,
    learning_rate=3e-3,
    n_pasted=3.0,
    distil=1.0,
    seen_twice=False,
    drawn_roads=True,
)

# LoDNN-I as published (20 GMAC). The paper's recipe lacks examples, not parameters: here are simulated and augmented
# scans, and a learning rate that batch norm allows.
PUBLISHED = Recipe(
    "lodnn",
    steps=3000,
    batch=16,
    reuse=6,
    learning_rate=2e-3,
    ema=0.999,
    n_pasted=3.0,
    turn_anywhere=0.2,
    drawn_roads=True,
    dropout=0.0,
)

# 690 epochs, which a GPU draws in ten minutes: with 152, and images in their own light, mean IoU was 72.3, not 75.1 %.
CAMSEG = Recipe(
    "camseg",
    steps=15_817,
    batch=16,
    learning_rate=2e-3,
    weight_decay=0.02,
    cooldown=0.8,
    ema=0.999,
    dropout=0.1,
    deep_supervision=0.4,
)

OBJECTS = Recipe(
    "objects",
    steps=30_000,
    batch=128,
    learning_rate=2e-3,
    weight_decay=0.02,
    cooldown=0.95,
    ema=0.999,
    dropout=0.1,
    redraw_every=0,
)

# Continued with its own boxes among the candidates, for the second look gets such boxes.
SECOND_LOOK = replace(OBJECTS, found_again=0.45, steps=12_000, learning_rate=1e-3)
OPEN_SECOND_LOOK = replace(SECOND_LOOK, steps=10_000, detector=False)

# Without KITTI, the 28 real scans are of one street: most scans are simulated. Three quarters of the channels, and int8
# alone, let three more models fit into the wheel.
OPEN = replace(EDGE, steps=3500, batch=8, reuse=1, ema=0.998, redraw_every=2000, simulated_share=0.8, width=0.75)

# Ten times as many samples, a third of the simulated scans by other sensors: on KITTI's drives kept back, IoU of the
# network alone rises from 21.6 to 29.3 % for pedestrians and from 16.5 to 35.5 % for cyclists. With KITTI's scans, more
# samples only made people of other drives worse (docs/concepts/training.md).
OPEN_POINTS = replace(EDGE, steps=9150, reuse=8, beams=0.4, cooldown=0.5, simulated_share=0.8, width=0.75)

# Poles and walls are classes here, and are not pasted as what is none.
SCENE = replace(
    OPEN,
    classes=("background", "car", "pedestrian", "cyclist", *STATIC),
    steps=4000,
    reuse=3,
    learning_rate=2e-3,
    simulated_share=0.65,
    n_pasted=3.0,
    n_negatives=0.0,
    turn_anywhere=0.7,
    redraw_every=1000,
)

# Continued with the curvature: without it vegetation looks like buildings, as bfloat16, in which networks are trained,
# holds the bends of leaves up to a few meters only.
CURVED = replace(
    SCENE,
    curvature=True,
    range_noise_m=0.01,
    beams=0.3,
    steps=1500,
    batch=16,
    reuse=2,
    learning_rate=1.5e-3,
    cooldown=0.6,
    redraw_every=0,
)

LAST = replace(CURVED, simulated_share=0.8, steps=1000)

OBJECT_SCANS = ("sensors", "halls")
_open = partial(Stage, is_open=True, also=("six-sensors",))

MODELS = {
    "pointseg-sim": Stage(Recipe("pointseg", simulated_share=1.0, steps=1000, learning_rate=2e-3, cooldown=0.3)),
    "pointseg-full": Stage(Recipe("pointseg", steps=3600, batch=4, learning_rate=1e-3), after="pointseg-sim"),
    "kulseg-start": Stage(KULSEG, teacher="pointseg-full"),
    # Continued without the focal loss: together with class weights it labels too many pixels pedestrian.
    "kulseg": Stage(
        replace(KULSEG, steps=1500, learning_rate=1e-3, cooldown=0.6, focal_gamma=0.0),
        after="kulseg-start",
        teacher="pointseg-full",
    ),
    "ssadnet-sim": Stage(replace(SSADNET, simulated_share=1.0, steps=1300, cooldown=0.3)),
    "ssadnet-full": Stage(replace(SSADNET, steps=2000), after="ssadnet-sim"),
    # With the segmentation branch of ssadnet-full, so that the two heads can be compared.
    "ssadnet-paper": Stage(
        replace(
            SSADNET,
            head="slots",
            head_only=True,
            batch=8,
            steps=700,
            learning_rate=2e-3,
            cooldown=0.5,
            redraw_every=0,
            ema=0.99,
        ),
        after="ssadnet-full",
    ),
    "lodnn-paper": Stage(PUBLISHED),
    "pointseg-start": Stage(EDGE),
    "pointseg": Stage(BEAMS, after="pointseg-start"),
    "pointseg-sparse": Stage(SPARSE, after="pointseg", also=("sparse",)),
    "lodnn": Stage(LODNN, teacher="ssadnet"),
    # Three quarters of the channels: with all of them it learned the training scans, and found 8 of 255 boxes less.
    "ssadnet": Stage(
        replace(
            EDGE, network="ssadnet", height_above_ground=False, front=True, drawn_roads=True, n_pasted=3.0, width=0.75
        )
    ),
    "camseg": Stage(CAMSEG),
    # The object network sees points, not beams: with scans of other sensors it learns how sparse an object may be.
    # Without halls it took walls, beams and pipes for trucks; without yards, trucks across the way for walls.
    "objects-start": Stage(OBJECTS, also=OBJECT_SCANS),
    "objects-again-start": Stage(SECOND_LOOK, after="objects-start", also=OBJECT_SCANS),
    "objects-yards-start": Stage(
        replace(SECOND_LOOK, runs=2), after="objects-again-start", also=(*OBJECT_SCANS, "yards")
    ),
    "objects": Stage(
        # Without the kept share, far trucks that stand across were lost: 53 in place of 58 of 60.
        replace(SECOND_LOOK, steps=19_000, thinned=True, kept=0.25),
        after="objects-yards-start",
        also=(*OBJECT_SCANS, "yards", "sparse"),
    ),
    "ssadnet-open": _open(
        replace(OPEN, network="ssadnet", height_above_ground=False, front=True, n_pasted=3.0), also=("sensors",)
    ),
    "objects-open-start": _open(replace(OBJECTS, steps=16_000, detector=False), also=OBJECT_SCANS),
    "objects-open-again-start": _open(OPEN_SECOND_LOOK, after="objects-open-start", also=OBJECT_SCANS),
    "objects-open-yards-start": _open(
        replace(OPEN_SECOND_LOOK, runs=2), after="objects-open-again-start", also=(*OBJECT_SCANS, "yards")
    ),
    "objects-open": _open(
        replace(OPEN_SECOND_LOOK, steps=9_000, thinned=True),
        after="objects-open-yards-start",
        also=(*OBJECT_SCANS, "yards"),
    ),
    "four-classes-start": _open(OPEN_POINTS),
    "scene-start": _open(SCENE, after="four-classes-start", also=("sensors",)),
    "sceneseg-start": _open(
        replace(SCENE, steps=10_800, batch=32, reuse=8, ema=0.999, beams=0.3, cooldown=0.5, redraw_every=4000),
        after="scene-start",
    ),
    "curved-start": _open(CURVED, after="sceneseg-start"),
    # 400,000 samples with the curvature, in eight minutes on a GPU, and then some on a processor in float32: cars, with
    # 79 % on SemanticKITTI, have 87 again, of 89 before.
    "long-start": _open(
        replace(LAST, steps=12_426, batch=32, reuse=6, learning_rate=2e-3, ema=0.999, redraw_every=4000),
        after="curved-start",
    ),
    "sceneseg": _open(LAST, after="long-start"),
}
"""The training run of every model, by name; names that end in ``-start`` are intermediate results."""
