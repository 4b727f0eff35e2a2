//! Types as other programs spell them: hashes, names, the fields of services.

use splat_msgs::correction_message::MapCorrectionMsg;
use splat_msgs::map_messages::{KeyframeArray, KeyframePoseMsg, SplatManifest};
use splat_msgs::ros::odometry::Odometry;
use splat_msgs::ros::standard::{
    DiagnosticArray, MarkerArray, Path, PointCloud2, PoseWithCovarianceStamped,
};
use splat_msgs::ros::{Image, PoseStamped, TfMessage};
use splat_msgs::services::SERVICES;
use splat_msgs::status_message::MapperStatus;
use splat_msgs::type_hash::{dds_type_name, service_hash, type_hash};

/// Made by rosbags 0.11 from the same definitions, an implementation apart from this one; the hash of TFMessage
/// also by rosidl of ROS 2 Jazzy.
#[test]
fn type_hashes_are_those_of_ros_2() {
    assert_eq!(
        type_hash::<PoseStamped>(),
        "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
    );
    assert_eq!(
        type_hash::<Image>(),
        "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    );
    assert_eq!(
        type_hash::<TfMessage>(),
        "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    );
    assert_eq!(
        type_hash::<SplatManifest>(),
        "RIHS01_d9cfd3a8140918ac501a45c04c77ef7542bce4930799ea7e572cdcb21213d2c7"
    );
    assert_eq!(
        type_hash::<KeyframePoseMsg>(),
        "RIHS01_15510c85564875936e57a31e7da2260c6c89ac8dcd818864e4ea564aacf4b2b8"
    );
    assert_eq!(
        type_hash::<KeyframeArray>(),
        "RIHS01_806a2f07d3cfca046a753e9369f2660b97174ae473b33db404d701f8a62a4e8a"
    );
    for (found, expected) in [
        (
            type_hash::<PoseWithCovarianceStamped>(),
            "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
        ),
        (
            type_hash::<Odometry>(),
            "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
        ),
        (
            type_hash::<Path>(),
            "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
        ),
        (
            type_hash::<PointCloud2>(),
            "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
        ),
        (
            type_hash::<MarkerArray>(),
            "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
        ),
        (
            type_hash::<DiagnosticArray>(),
            "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
        ),
        (
            type_hash::<MapperStatus>(),
            "7f2d7a2057d65ec119ac5384e7eae30d7db021ed488548c442a061b9ecda7e19",
        ),
        (
            type_hash::<MapCorrectionMsg>(),
            "9104ab9eb0b6d2fe2fbeb197ff32c112b3e3ca662c47ddfb5d47cdb6c7cf5e5c",
        ),
    ] {
        assert_eq!(found, format!("RIHS01_{expected}"));
    }
    assert_eq!(
        dds_type_name::<PoseStamped>(),
        "geometry_msgs::msg::dds_::PoseStamped_"
    );
}

/// By rosidl of ROS 2 Jazzy; that of `render_view` by the type descriptions of rosbags 0.11, which gives the same for the others.
#[test]
fn hashes_of_services_are_those_of_ros_2() {
    let expected = [
        (
            "save_map",
            "8827476c1dad89884b6b6cebc2d2e3447261d0b848a17c1761b09d0bbb140409",
        ),
        (
            "load_map",
            "0fec098bb8aca37c58c2190e005af6b5f8ff26ae2abc9d3cdb4e61633317b4bb",
        ),
        (
            "export",
            "c22bfbe66406c0ce48baf0c99d66f16868bfdba81ca272449e1aa5fb2a7a562a",
        ),
        (
            "render_view",
            "cbd7d77033887f69ad6f44bd1d3bd2c81ed81ce7a4efdfd8867953ff18dd5971",
        ),
        (
            "reset",
            "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
        ),
    ];
    for (name, hash) in expected {
        let service = SERVICES.iter().find(|s| s.name == name).unwrap();
        let found = service_hash(
            service.type_name,
            service.request_definition,
            service.response_definition,
        );
        assert_eq!(found, format!("RIHS01_{hash}"), "{name}");
    }
}

/// The files of msgs/srv say the same as the node.
#[test]
fn services_are_as_their_files_say() {
    let fields = |text: &str| -> Vec<String> {
        let lines = text.lines().map(|l| l.split('#').next().unwrap().trim());
        lines
            .filter(|l| !l.is_empty())
            .map(|l| l.split_whitespace().collect::<Vec<_>>().join(" "))
            .collect()
    };
    for service in &SERVICES {
        let Some(name) = service.type_name.strip_prefix("splat_mapper_msgs/srv/") else {
            continue;
        };
        let file = std::fs::read_to_string(format!("msgs/srv/{name}.srv")).unwrap();
        let (request, response) = file.split_once("---").unwrap();
        let root = |definition: &str| definition.split("====").next().unwrap().to_owned();
        assert_eq!(
            fields(request),
            fields(&root(service.request_definition)),
            "{name}"
        );
        assert_eq!(
            fields(response),
            fields(&root(service.response_definition)),
            "{name}"
        );
    }
}
