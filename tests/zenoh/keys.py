"""Key expressions and liveliness tokens as pyzeros, an rmw_zenoh of its own, spells them."""

from pyzeros import pub, service_common
from pyzeros.qos import QosProfile

NODE = "splat_mapper"


def latched(depth):
    return QosProfile(depth=depth, durability="transient_local")


def reliable(depth):
    return QosProfile(depth=depth)


NEWEST = QosProfile(depth=5, reliability="best_effort")

# docs/TOPICS.md: full name, type, delivery.
TOPICS = [
    ("/splat_mapper/pose", "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_", NEWEST),
    ("/splat_mapper/odometry", "nav_msgs::msg::dds_::Odometry_", NEWEST),
    ("/tf", "tf2_msgs::msg::dds_::TFMessage_", reliable(100)),
    ("/splat_mapper/path", "nav_msgs::msg::dds_::Path_", latched(1)),
    ("/splat_mapper/cloud", "sensor_msgs::msg::dds_::PointCloud2_", latched(1)),
    ("/splat_mapper/keyframe_cloud", "sensor_msgs::msg::dds_::PointCloud2_", NEWEST),
    ("/splat_mapper/grid", "nav_msgs::msg::dds_::OccupancyGrid_", latched(1)),
    ("/splat_mapper/grid_updates", "map_msgs::msg::dds_::OccupancyGridUpdate_", reliable(10)),
    ("/splat_mapper/distance_slice", "nvblox_msgs::msg::dds_::DistanceMapSlice_", latched(1)),
    ("/splat_mapper/ellipsoids", "splat_mapper_msgs::msg::dds_::EllipsoidArray_", latched(1)),
    ("/splat_mapper/voxels", "sensor_msgs::msg::dds_::PointCloud2_", latched(1)),
    ("/tf_static", "tf2_msgs::msg::dds_::TFMessage_", latched(1)),
    ("/splat_mapper/frusta", "visualization_msgs::msg::dds_::MarkerArray_", latched(1)),
    ("/splat_mapper/keyframes", "splat_mapper_msgs::msg::dds_::KeyframeArray_", latched(64)),
    ("/splat_mapper/splats/manifest", "splat_mapper_msgs::msg::dds_::SplatManifest_", latched(1)),
    ("/splat_mapper/splats", "splat_mapper_msgs::msg::dds_::SplatChunk_", reliable(1000)),
    ("/splat_mapper/splats/delta", "splat_mapper_msgs::msg::dds_::SplatDelta_", reliable(64)),
    ("/splat_mapper/submaps/manifest", "splat_mapper_msgs::msg::dds_::SplatManifest_", latched(64)),
    ("/splat_mapper/submaps/keyframes", "splat_mapper_msgs::msg::dds_::KeyframeArray_", latched(64)),
    ("/splat_mapper/submaps/splats", "splat_mapper_msgs::msg::dds_::SplatChunk_", latched(256)),
    ("/splat_mapper/correction", "splat_mapper_msgs::msg::dds_::MapCorrection_", latched(10)),
    ("/splat_mapper/status", "splat_mapper_msgs::msg::dds_::MapperStatus_", latched(1)),
    ("/diagnostics", "diagnostic_msgs::msg::dds_::DiagnosticArray_", reliable(10)),
]
SERVICES = [
    ("/splat_mapper/save_map", "splat_mapper_msgs::srv::dds_::SaveMap_"),
    ("/splat_mapper/load_map", "splat_mapper_msgs::srv::dds_::LoadMap_"),
    ("/splat_mapper/export", "splat_mapper_msgs::srv::dds_::Export_"),
    ("/splat_mapper/reset", "std_srvs::srv::dds_::Trigger_"),
    ("/splat_mapper/pause", "std_srvs::srv::dds_::Trigger_"),
    ("/splat_mapper/resume", "std_srvs::srv::dds_::Trigger_"),
    ("/splat_mapper/get_splats", "splat_mapper_msgs::srv::dds_::GetSplats_"),
    ("/splat_mapper/render_view", "splat_mapper_msgs::srv::dds_::RenderView_"),
    ("/splat_mapper/get_distances", "splat_mapper_msgs::srv::dds_::GetDistances_"),
    ("/splat_mapper/get_distance_box", "splat_mapper_msgs::srv::dds_::GetDistanceBox_"),
    ("/splat_mapper/get_ellipsoids", "splat_mapper_msgs::srv::dds_::GetEllipsoids_"),
    ("/splat_mapper/get_mesh", "splat_mapper_msgs::srv::dds_::GetMesh_"),
]


def hash_in(token):
    """The hash alone is taken over: rosbags and rosidl are asked about those."""
    return token.split("/")[-2]


def expected(token, name, kind, qos, ours):
    """The token that a node has for this topic or service, with its own numbers. `ours`: pyzeros wants a session, whatever for."""
    _, domain, session, node, entity, letters = token.split("/")[:6]
    spelled = dict(name=name, dds_type=kind, hash=hash_in(token), qos_profile=qos, node_name=NODE, domain_id=domain,
                   namespace="/", _node_id=node, _zenoh_id=session, _entity_id=entity, session=ours)
    if letters == "MP":
        return pub.token_keyexpr(**spelled)
    return service_common.token_keyexpr(entity_kind=letters, **spelled)


def check(tokens, keys, ours, expect):
    """`tokens` of the node, `keys` of all that came."""
    mine = [t for t in tokens if t.split("/")[8] == NODE]
    spelled = {t.split("/")[9]: t for t in mine if t.split("/")[5] in ("MP", "SS")}
    wanted = [(name, kind, qos) for name, kind, qos in TOPICS] + [(name, kind, QosProfile.services()) for name, kind in SERVICES]
    wrong = []
    for name, kind, qos in wanted:
        token = spelled.get(name.replace("/", "%"), "")
        if not token or expected(token, name, kind, qos, ours) != token:
            wrong.append((name, token))
    unknown = sorted(set(spelled) - {name.replace("/", "%") for name, *_ in wanted})
    expect(not wrong and not unknown, f"tokens of {len(wanted)} topics and services are as pyzeros spells them {wrong}, and there are no others {unknown}")
    hashes = {name: hash_in(spelled[name.replace("/", "%")]) for name, _, _ in TOPICS}
    known = {pub.publisher_keyexpr(name, kind, hashes[name], domain_id=0) for name, kind, _ in TOPICS}
    expect(set(keys) <= known, f"and so are the {len(set(keys))} keys that messages came under")
