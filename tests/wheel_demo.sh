#!/usr/bin/env bash
# Build the wheel (through the sdist), look at what is in it, install it into an empty environment outside the
# checkout and run the demo there. PYTHON is an interpreter that has `build`. With KERNELS=ahead the checkout has compiled
# kernels (.ci/kernels), and the environment must have no numba.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
checkout=$PWD
python=$(command -v "${PYTHON:-python3}")
[[ $python = /* ]] || python=$checkout/$python
away=$(cd "$(mktemp -d)" && pwd -P)
trap 'rm -rf "$away"' EXIT

"$python" -m build ${KERNELS:+--wheel} --outdir "$away/dist" . >"$away/build.log" 2>&1 || { cat "$away/build.log"; exit 1; }
"$python" - "$away"/dist/*.whl <<'END'
import pathlib, sys, zipfile

names = zipfile.ZipFile(sys.argv[1]).namelist()
top = {name.split("/")[0] for name in names if ".dist-info/" not in name}
assert top == {"edgeperc", "edgeperc_bench", "edgeperc_export"}, f"the wheel installs {sorted(top)}"
assert "edgeperc/py.typed" in names and "edgeperc/zoo/__init__.py" in names, names
models = {name for name in names if name.endswith(".onnx")}
assert {"edgeperc/zoo/ssadnet.onnx", "edgeperc/zoo/pointseg.onnx"} <= models, f"the wheel has the models {sorted(models)}"
assert not [name for name in names if "research" in name], "a research model is in the wheel"
megabytes = pathlib.Path(sys.argv[1]).stat().st_size / 1e6
most = 9.0 if any(name.endswith((".so", ".pyd")) for name in names) else 8.0  # compiled kernels: 0.35 MB a level
assert megabytes <= most, f"the wheel has {megabytes:.1f} MB, more than {most:g}"
END

"$python" -m venv "$away/venv"
wheel=$(echo "$away"/dist/*.whl)
"$away/venv/bin/pip" install --quiet --no-compile "${wheel}[cpu,view]"
"$away/venv/bin/pip" check
if [[ ${KERNELS:-} ]] && "$away/venv/bin/pip" show --quiet numba; then echo "numba is installed"; exit 1; fi
# Kernels that the checkout compiled are not compiled again, a minute of two cores: test_warm_up.py compiles them all.
"$away/venv/bin/python" - <<'END'
import contextlib, pathlib, shutil, sysconfig

packages = pathlib.Path(sysconfig.get_path("purelib"))
for kernel in pathlib.Path("edgeperc").rglob("*.kernel"):
    (packages / kernel).parent.mkdir(exist_ok=True)
    with contextlib.suppress(FileNotFoundError):  # replaced by a process of other tests
        shutil.copy(kernel, packages / kernel)
END
cd "$away"
"$away/venv/bin/python" -c "import edgeperc; assert edgeperc.__file__.startswith('$away'), edgeperc.__file__"
"$away/venv/bin/edgeperc" doctor
"$away/venv/bin/edgeperc" demo --out demo
[ -n "$(find demo -name '*.png' -size +1k)" ] || { echo "the demo made no picture in $away/demo"; exit 1; }
echo "The wheel works outside the checkout: $(du -h "$wheel" | cut -f1), $(find demo -type f | tr '\n' ' ')"
