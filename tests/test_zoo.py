"""Names of models, and the one rule for the variant and precision that run."""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from dataclasses import replace
from importlib import resources
from pathlib import Path

import pytest

import edgeperc.zoo as zoo
from checkout import files
from edgeperc.errors import CardError, ModelFileError, ProviderError
from edgeperc.zoo import DEFAULT, MAX_LOSS, OPEN, Variant, choose, digest, listed, model_path, resolve, shipped_models

VNNI, BF16 = frozenset({"avx512_vnni"}), frozenset({"avx512_bf16"})
BOTH = VNNI | BF16
AVX2 = frozenset({"avx2"})


def variants(**losses: float) -> tuple[Variant, Variant]:
    """pointseg in fp32 and int8, with these losses in their cards."""
    of_name = {variant.precision: variant for variant in resolve("pointseg")}
    records = {precision: {"loss": loss} for precision, loss in losses.items()}
    return tuple(  # type: ignore[return-value]
        Variant(of_name[stored].path, replace(of_name[stored].card, precisions=records)) for stored in ("fp32", "int8")
    )


def test_every_name_has_one_file_per_variant() -> None:
    shipped = "camseg lodnn objects objects-open pointseg pointseg-sparse sceneseg ssadnet ssadnet-open"
    assert shipped_models() == tuple(shipped.split())
    assert {*DEFAULT, *OPEN} <= set(shipped_models())
    names = [str(variant) for variant in listed()]
    assert len(names) == len(set(names))
    for variant in listed():
        assert resolve(str(variant)) == (variant,)
        assert resolve(variant.path) == resolve(str(variant.path)) == (variant,)
        assert model_path(str(variant)) == variant.path
        assert variant in listed(variant.name)  # by which a name is found without reading every card


def test_name_gives_its_variants_fp32_first() -> None:
    for name in DEFAULT:
        assert [variant.precision for variant in resolve(name)] == ["fp32", "int8"]
        assert model_path(name) == resolve(name)[0].path
        fp32, int8 = resolve(name)
        assert (fp32.card.view, fp32.card.classes) == (int8.card.view, int8.card.classes)


def test_the_wheels_models_are_small() -> None:
    """Compressed as in a wheel, which leaves out some (pyproject.toml)."""
    left_out = ("camseg:fp32", "lodnn:int8", "pointseg-sparse:fp32")
    files = [variant.path for variant in listed() if str(variant) not in left_out]
    assert sum(len(zlib.compress(path.read_bytes(), 6)) for path in files) <= 6.9e6


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("pointseg-sim", "models/research/pointseg-sim\\.onnx"),
        ("pointseg:bf16", "pointseg:fp32 and pointseg:int8.*ask for precision 'bf16'"),
        (
            "pointnet",
            "no model is called 'pointnet' \\(did you mean pointseg\\?\\). Shipped: camseg, lodnn, objects, "
            "objects-open, pointseg, pointseg-sparse, sceneseg, ssadnet, ssadnet-open",
        ),
        ("", "no model is called ''"),
        ("nowhere.onnx", "nowhere.onnx"),
    ],
)
def test_a_name_that_no_model_has_is_refused(model: str, message: str) -> None:
    with pytest.raises(ModelFileError, match=message):
        resolve(model)


def test_models_in_an_archive_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zipfile.ZipFile(tmp_path / "site.zip", "w").close()
    monkeypatch.setattr(resources, "files", lambda _: zipfile.Path(tmp_path / "site.zip"))
    with pytest.raises(ModelFileError, match=r"site\.zip/ lies in an archive.*; unpack it"):
        resolve("pointseg")


def test_research_models_lie_where_the_message_says() -> None:
    research = files(".onnx", "models/research")
    if not research:
        pytest.skip("tests of an installed package")
    assert {path.stem for path in research} == {*zoo.RESEARCH, *OPEN}  # of the last ones, fp32
    for path in research:
        (variant,) = resolve(path)
        assert (variant.name, variant.precision) == (path.stem, "fp32")


def test_a_file_without_a_card_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.onnx").write_bytes(b"")
    with pytest.raises(CardError):
        resolve(tmp_path / "empty.onnx")


@pytest.mark.parametrize(
    ("provider", "features", "losses", "precision"),
    [
        ("cpu", VNNI, {"int8": 0.0}, "int8"),
        ("cpu", VNNI, {"int8": MAX_LOSS}, "int8"),
        ("cpu", VNNI, {"int8": MAX_LOSS + 0.01}, "fp32"),
        ("cpu", VNNI, {}, "fp32"),
        ("cpu", AVX2, {"int8": 0.0}, "fp32"),
        ("cpu", frozenset(), {"int8": 0.0}, "fp32"),
        ("cpu", BF16, {"bf16": 0.0}, "fp32"),
        ("cuda", BOTH, {"int8": 0.0, "bf16": 0.0}, "fp32"),
        ("openvino", BOTH, {"int8": 0.0, "bf16": 0.0}, "int8"),
        ("openvino", BF16, {"int8": 0.0, "bf16": 0.0}, "bf16"),
        ("openvino", BOTH, {"int8": 1.0, "bf16": 0.0}, "bf16"),
        ("openvino", BOTH, {"int8": 1.0, "bf16": 1.0}, "fp32"),
        ("openvino", frozenset(), {"int8": 0.0, "bf16": 0.0}, "fp32"),
    ],
)
def test_auto_takes_native_precisions_with_a_measured_loss(
    provider: str, features: frozenset[str], losses: dict[str, float], precision: str
) -> None:
    fp32, int8 = variants(**losses)
    assert choose((fp32, int8), provider, "auto", features) == (int8 if precision == "int8" else fp32, precision)


@pytest.mark.parametrize(
    ("provider", "features", "weight_bits", "precision"),
    [
        ("cpu", AVX2, 7, "int8"),
        ("cpu", AVX2, 8, "fp32"),
        ("cpu", AVX2 | VNNI, 8, "int8"),
        ("cpu", frozenset({"ssse3"}), 7, "fp32"),
        ("openvino", AVX2, 7, "fp32"),
    ],
)
def test_without_a_dot_product_of_bytes_auto_takes_seven_bits(
    provider: str, features: frozenset[str], weight_bits: int, precision: str
) -> None:
    fp32, int8 = variants()
    record = {"int8": {"loss": 0.0, "weight_bits": weight_bits}}
    int8 = replace(int8, card=replace(int8.card, precisions=record))
    assert choose((fp32, int8), provider, "auto", features) == (int8 if precision == "int8" else fp32, precision)


def test_requested_precision_needs_no_measured_loss() -> None:
    fp32, int8 = variants()
    for features in (frozenset[str](), BOTH):
        assert choose((fp32, int8), "cpu", "int8", features) == (int8, "int8")
        assert choose((fp32, int8), "openvino", "bf16", features) == (fp32, "bf16")
        assert choose((fp32, int8), "openvino", "fp32", features) == (fp32, "fp32")


def test_a_file_in_int8_alone_runs_in_int8() -> None:
    _, int8 = variants()
    assert choose((int8,), "cpu", "auto", frozenset()) == (int8, "int8")
    with pytest.raises(ProviderError, match="only in int8"):
        choose((int8,), "cpu", "fp32", VNNI)
    with pytest.raises(ProviderError, match="a model in fp32"):
        choose((int8,), "openvino", "bf16", BOTH)


def test_bf16_is_refused_where_it_is_not_native() -> None:
    with pytest.raises(ProviderError, match="a processor with amx_bf16 or avx512_bf16"):
        choose(variants(bf16=0.0), "openvino", "bf16", VNNI)
    with pytest.raises(ProviderError, match="bf16 needs provider 'openvino'"):
        choose(variants(bf16=0.0), "cpu", "bf16", BOTH)


def test_shipped_cards_have_the_loss_of_every_precision() -> None:
    for name in DEFAULT:
        fp32, int8 = resolve(name)
        assert set(fp32.card.precisions) == ({"fp32"} if name == "objects" else {"fp32", "bf16"})
        assert set(int8.card.precisions) == {"int8"}
        for precision, record in {**fp32.card.precisions, **int8.card.precisions}.items():
            assert record["n_scans"] >= 100
            assert record["loss"] <= MAX_LOSS, (name, precision)
            assert record["label_agreement"] > 0.99


def test_digest_covers_every_file() -> None:
    fp32, int8 = resolve("pointseg")
    assert digest([fp32]) == hashlib.sha256(fp32.path.read_bytes()).hexdigest()
    assert len({digest([fp32]), digest([int8]), digest([fp32, int8])}) == 3
    with pytest.raises(ModelFileError, match="cannot be read"):
        digest([Variant(Path("nowhere.onnx"), fp32.card)])
