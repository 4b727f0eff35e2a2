"""The launch files name what there is: arguments of the program, parameters of params.yaml. Runs them on a stand-in for the
launch packages, which the wheels lack."""

import pathlib
import runpy
import subprocess
import sys
import types
import xml.etree.ElementTree as xml

import yaml

from mapper import ROOT, Checks

check = Checks()
LAUNCH = ROOT / "launch"


def known_parameters():
    tree = yaml.safe_load((LAUNCH / "params.yaml").read_text())["splat_mapper"]["ros__parameters"]

    def keys(prefix, node):
        for name, value in node.items():
            if isinstance(value, dict):
                yield from keys(f"{prefix}{name}.", value)
            else:
                yield prefix + name

    return set(keys("", tree))


class Made:
    """Whatever a launch file makes: keeps its arguments."""

    made = []

    def __init__(self, *arguments, **named):
        self.arguments, self.named = arguments, named
        Made.made.append(self)


def stand_in(names):
    for name in names:
        module_name, _, kind = name.rpartition(".")
        for part in [module_name.rsplit(".", n)[0] for n in range(module_name.count("."), -1, -1)]:
            sys.modules.setdefault(part, types.ModuleType(part))
        setattr(sys.modules[module_name], kind, type(kind, (Made,), {}))


def python_launch_files(parameters):
    stand_in(
        """launch.LaunchDescription launch.actions.DeclareLaunchArgument launch.actions.EmitEvent launch.actions.ExecuteProcess
        launch.actions.IncludeLaunchDescription launch.actions.OpaqueFunction launch.actions.RegisterEventHandler launch.event_handlers.OnProcessExit
        launch.events.Shutdown launch.launch_description_sources.PythonLaunchDescriptionSource
        launch.substitutions.LaunchConfiguration launch.substitutions.PythonExpression launch_ros.actions.Node
        launch_ros.parameter_descriptions.ParameterValue""".split()
    )
    packages = types.ModuleType("ament_index_python.packages")
    packages.get_package_share_directory = lambda name: f"/share/{name}"
    sys.modules["ament_index_python"] = types.ModuleType("ament_index_python")
    sys.modules["ament_index_python.packages"] = packages
    for file in sorted(LAUNCH.glob("*.launch.py")):
        Made.made = []
        runpy.run_path(str(file))["generate_launch_description"]()
        kinds = [type(made).__name__ for made in Made.made]
        check(f"{file.name} makes a description", "LaunchDescription" in kinds)
        declared = {made.arguments[0] for made in Made.made if type(made).__name__ == "DeclareLaunchArgument"}
        used = {made.arguments[0] for made in Made.made if type(made).__name__ == "LaunchConfiguration"}
        check(f"{file.name} declares what it uses", used <= declared, used - declared)
        for node in (made for made in Made.made if type(made).__name__ == "Node"):
            named = {key for entry in node.named["parameters"] if isinstance(entry, dict) for key in entry}
            check(f"{file.name} sets parameters that exist", named and named <= parameters, named - parameters)
            flags = [word for word in node.named["arguments"] if isinstance(word, str)]
            check(f"{file.name} starts run --source", flags[:2] == ["run", "--source"], flags)


def nav2_parameters():
    """Merged into parameters of a user: those that ours name are ours, all others stay, and the parser of ROS takes the result."""
    merged = runpy.run_path(str(LAUNCH / "nav2.launch.py"))["merged"]
    own = yaml.safe_load((LAUNCH / "nav2.params.yaml").read_text())
    costmap = {"ros__parameters": {"plugins": ["voxel_layer"], "resolution": 0.1, "footprint": "[]"}}
    both = merged({"global_costmap": {"global_costmap": costmap}, "amcl": {"alpha1": 0.2}}, own)
    found = both["global_costmap"]["global_costmap"]["ros__parameters"]
    check("parameters of a user stay", found["footprint"] == "[]" and found["resolution"] == 0.1 and "amcl" in both)
    check("the layers are ours", found["plugins"][0] == "static_layer" and found["track_unknown_space"], found["plugins"])
    check("unlike YAML, ROS knows no aliases", "&" not in yaml.safe_dump(both))
    topics = {found["static_layer"]["map_topic"], found["obstacle_layer"]["keyframes"]["topic"]}
    check("they read what the node sends", topics == {"/splat_mapper/grid", "/splat_mapper/keyframe_cloud"}, topics)


def xml_launch_file(parameters):
    root = xml.parse(LAUNCH / "mapper.launch.xml").getroot()
    declared = {arg.get("name") for arg in root.findall("arg")}
    text = (LAUNCH / "mapper.launch.xml").read_text()
    used = {part.split(")")[0] for part in text.split("$(var ")[1:]}
    check("mapper.launch.xml declares what it uses", used <= declared, used - declared)
    named = {param.get("name") for param in root.iter("param") if param.get("name")}
    check("mapper.launch.xml sets parameters that exist", named and named <= parameters, named - parameters)


def package(parameters):
    """The package with the launch files installs what a launch file looks for."""
    build = pathlib.Path(sys.prefix).parent / "build-launch"
    install = build / "install"
    program = pathlib.Path(sys.executable).resolve()
    run = lambda *words: subprocess.run(words, check=True, capture_output=True)  # noqa: E731
    try:
        run(
            *["cmake", "-S", str(LAUNCH), "-B", str(build), "-G", "Ninja", f"-DCMAKE_PREFIX_PATH={sys.prefix}"],
            *[f"-DCMAKE_INSTALL_PREFIX={install}", f"-DSPLAT_MAPPER_PROGRAM={program}"],
            *[f"-DPython3_EXECUTABLE={sys.executable}"],
        )
        run("cmake", "--build", str(build), "--target", "install")
    except subprocess.CalledProcessError as error:
        check("the package with the launch files builds", False, error.stderr.decode()[-500:])
        return
    share = install / "share/splat_mapper"
    launches = ["mapper.launch.py", "mapper.launch.xml", "nav2.launch.py", "replay.launch.py"]
    wanted = [*(f"launch/{name}" for name in launches), "params.yaml", "nav2.params.yaml", "fastdds.xml"]
    missing = [name for name in wanted if not (share / name).is_file()]
    check("the package installs its launch files", not missing, missing)
    marker = install / "share/ament_index/resource_index/packages/splat_mapper"
    check("ros2 launch finds the package", marker.is_file())
    check("and its program", (install / "lib/splat_mapper" / program.name).is_file())


def main():
    parameters = known_parameters()
    python_launch_files(parameters)
    nav2_parameters()
    xml_launch_file(parameters)
    package(parameters)
    print(f"{check.n - check.n_failed} of {check.n} checks of the launch files are good")
    sys.exit(check.n_failed > 0)


if __name__ == "__main__":
    main()
