"""Packaging of meslam_core for colcon, with the optional compiled field kernel."""

from pathlib import Path

from setuptools import Extension, find_packages, setup

NAME = "meslam_core"
# colcon runs a symlink of this file in its build folder: the folders beside the real file count.
KERNEL_DIR = Path(__file__).resolve().parent / "src_cpp"


def kernel_extensions() -> list[Extension]:
    """The compiled kernel, where its sources and pybind11 are there; it may fail to compile.

    `optional` turns a failed compilation into a warning: the package then works with its
    reference implementation alone.
    """
    sources = sorted(map(str, KERNEL_DIR.glob("*.cpp")))
    if not sources:
        return []
    try:
        from pybind11.setup_helpers import Pybind11Extension
    except ImportError:
        print("warning: pybind11 is missing, so the compiled field kernel is not built")
        return []
    return [
        Pybind11Extension(
            f"{NAME}.field._kernel",
            sources,
            cxx_std=17,
            include_dirs=[str(KERNEL_DIR)],
            depends=sorted(map(str, KERNEL_DIR.glob("*.h*"))),
            # No -ffast-math: it would let the compiler assume that no number is infinite or NaN.
            extra_compile_args=["-O3", "-fno-math-errno", "-fno-trapping-math"],
            optional=True,
        )
    ]


setup(
    name=NAME,
    version="0.1.0",
    description="Dense RGB-D SLAM with neural maps: the method and the meslam command",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "report/templates/*"]},
    ext_modules=kernel_extensions(),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    zip_safe=False,
    entry_points={"console_scripts": ["meslam = meslam_core.cli:main"]},
)
