"""What would abort the process is found before it can; the variant is chosen at run time."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from curio_train.errors import RendererError
from curio_train.rendering import llvm, variant


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder in which libLLVM is looked for."""
    monkeypatch.setattr(llvm, "LIBRARY_FOLDERS", (str(tmp_path),))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-15.so.1", 15),
        ("libLLVM.so.19.1", 19),
        ("libLLVM-17.so", 17),
        ("libLLVM.so.18", 18),
        ("libLLVM.so", None),
    ],
)
def test_version_is_read_off_the_name(name: str, version: int | None) -> None:
    assert llvm.llvm_version(f"/usr/lib/{name}") == version


def test_newest_library_is_taken(folder: Path) -> None:
    for name in ("libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-17.so.1"):
        (folder / name).touch()
    assert llvm.check_llvm() == str(folder / "libLLVM.so.19.1")


def test_a_missing_library_names_the_package(folder: Path) -> None:
    with pytest.raises(RendererError, match=r"No libLLVM was found .*17 or newer.*apt-get install libllvm19"):
        llvm.check_llvm()


def test_an_old_library_is_refused_before_it_is_loaded(folder: Path) -> None:
    (folder / "libLLVM-15.so.1").touch()
    with pytest.raises(RendererError, match=r"libLLVM-15\.so\.1 is LLVM 15.*needs 17 or newer.*libllvm19"):
        llvm.check_llvm()


def test_the_variable_wins(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "libLLVM.so.19.1").touch()
    (folder / "libLLVM-14.so.1").touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(folder / "libLLVM-14.so.1"))
    with pytest.raises(RendererError, match="LLVM 14"):
        llvm.check_llvm()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(folder / "nowhere.so"))
    with pytest.raises(RendererError, match=r"nowhere\.so"):
        llvm.check_llvm()


def test_an_old_library_ends_in_a_message_not_in_an_abort(tmp_path: Path) -> None:
    """The whole way, in a process of its own."""
    (tmp_path / "libLLVM-15.so.1").touch()
    code = (
        "from curio_train.rendering.variant import load_mitsuba\n"
        "from curio_train.errors import RendererError\n"
        "try:\n    load_mitsuba()\n"
        "except RendererError as error:\n    print(error)\n"
    )
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(tmp_path / "libLLVM-15.so.1")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "is LLVM 15" in done.stdout


def test_without_cuda_images_are_rendered_on_the_cpu(caplog: pytest.LogCaptureFixture) -> None:
    if variant.optix_available():
        pytest.skip("this machine has OptiX")
    variant._say_fallback_once.cache_clear()
    assert variant.choose_variant(prefer_cuda=False) == "llvm_ad_rgb"
    assert not caplog.records
    assert [variant.choose_variant(prefer_cuda=True) for _ in range(3)] == ["llvm_ad_rgb"] * 3
    assert len(caplog.records) == 1
    assert "libnvoptix.so.1" in caplog.text


def test_cuda_is_taken_where_the_driver_brings_optix(monkeypatch: pytest.MonkeyPatch) -> None:
    """With two libraries that every machine can load standing for the driver's."""
    monkeypatch.delenv(variant.FORCED, raising=False)
    monkeypatch.setattr(variant, "CUDA_LIBRARIES", ("libc.so.6", "libm.so.6"))
    assert variant.choose_variant(prefer_cuda=True) == "cuda_ad_rgb"
    assert variant.choose_variant(prefer_cuda=False) == "llvm_ad_rgb"


def test_without_optix_cuda_is_left_to_the_networks(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv(variant.FORCED, raising=False)
    monkeypatch.setattr(variant, "CUDA_LIBRARIES", ("libc.so.6", "libnowhere.so.1"))
    variant._say_fallback_once.cache_clear()
    assert [variant.choose_variant(prefer_cuda=True) for _ in range(3)] == ["llvm_ad_rgb"] * 3
    assert len(caplog.records) == 1
    assert "networks stay on the GPU" in caplog.text


def test_the_environment_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant, "CUDA_LIBRARIES", ("libc.so.6", "libm.so.6"))
    monkeypatch.setenv(variant.FORCED, "llvm_ad_rgb")
    assert variant.choose_variant(prefer_cuda=True) == "llvm_ad_rgb"
    monkeypatch.setenv(variant.FORCED, "scalar_rgb")
    with pytest.raises(RendererError, match="CURIO_VARIANT is 'scalar_rgb', expected one of llvm_ad_rgb, cuda_ad_rgb"):
        variant.choose_variant(prefer_cuda=True)


def test_a_second_variant_is_refused(mitsuba) -> None:
    with pytest.raises(RendererError, match="already runs as llvm_ad_rgb"):
        variant.load_mitsuba("cuda_ad_rgb")
