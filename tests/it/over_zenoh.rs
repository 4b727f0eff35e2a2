//! Snapshots over zenoh: separate sessions on loopback, before and after the publisher, healthy, hostile and stalled.
#![cfg(feature = "zenoh")]

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use zenoh::query::ConsolidationMode;
use zenoh::sample::Sample;
use zenoh::{Config, Session, Wait};

use crate::formats::random_snapshot;
use splat_mapper::node::save_map::{MapFile, save_map};
use splat_mapper::params::settings::Settings;
use splat_msgs::client::assembler::Assembler;
use splat_msgs::map_messages::{KeyframeArray, SplatChunk, SplatManifest};
use splat_msgs::ros;
use splat_msgs::ros::standard::Path;
use splat_msgs::services::SERVICES;
use splat_msgs::type_hash::dds_type_name;
use splat_ros::error::PublishError;
use splat_ros::odometry;
use splat_ros::output::{Output, topics};
use splat_ros::params::PublishParams;
use splat_types::snapshot::Snapshot;
use splat_types::time::Stopwatch;

pub const MAX_BYTES: usize = 64 << 20;

/// Loopback delivers in milliseconds; so long waits only a test that fails.
pub const PATIENCE: Duration = Duration::from_secs(20);

fn params(listen: &str) -> PublishParams {
    let mut params = Settings::shipped().params().unwrap().publish;
    params.scouting = false;
    params.zenoh = true;
    params.full_map_period = 0.0;
    params.zenoh_listen = listen.to_owned();
    params
}

pub fn client(listen: &str, connect: &str) -> Session {
    let mut config = Config::default();
    config
        .insert_json5("scouting/multicast/enabled", "false")
        .unwrap();
    config
        .insert_json5(
            "listen/endpoints",
            &format!("[{listen:?}]").replace("\"\"", ""),
        )
        .unwrap();
    config
        .insert_json5(
            "connect/endpoints",
            &format!("[{connect:?}]").replace("\"\"", ""),
        )
        .unwrap();
    zenoh::open(config).wait().unwrap()
}

pub fn take(assembler: &mut Assembler, sample: &Sample) -> Option<Snapshot> {
    let dds_type = sample.key_expr().as_str().rsplit('/').nth(1).unwrap();
    let is_of_map = dds_type == dds_type_name::<SplatChunk>()
        || dds_type == dds_type_name::<SplatManifest>()
        || dds_type == dds_type_name::<KeyframeArray>();
    if !is_of_map {
        return None;
    }
    assembler.add_payload(dds_type, &sample.payload().to_bytes())
}

/// Asks like a late joiner until the publisher is connected and its snapshot whole.
pub fn ask(session: &Session, key: &str) -> Option<Snapshot> {
    let started = Stopwatch::start();
    while started.elapsed() < PATIENCE {
        let mut assembler = Assembler::new(MAX_BYTES);
        let replies = session
            .get(key)
            .consolidation(ConsolidationMode::None)
            .wait()
            .unwrap();
        let complete = replies
            .into_iter()
            .filter_map(|r| r.into_result().ok())
            .find_map(|s| take(&mut assembler, &s));
        if complete.is_some() {
            return complete;
        }
        // Not connected: zenoh tries again on its own, there is nothing to wait on.
        std::thread::park_timeout(Duration::from_millis(50));
    }
    None
}

fn publish(output: &mut Output, snapshot: &Arc<Snapshot>) {
    let publisher = &output.handles.publisher;
    let sent = output.streams.map.publish(publisher, snapshot, false, 0);
    sent.unwrap();
}

pub fn free_endpoint() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    format!("tcp/{}", listener.local_addr().unwrap())
}

#[test]
fn a_late_joiner_gets_the_newest_snapshot_and_the_same_ply() {
    let mut output = Output::open(&params("tcp/127.0.0.1:0"), Vec::new()).unwrap();
    let endpoints = output.handles.publisher.endpoints();
    assert!(
        endpoints.len() == 1 && !endpoints[0].ends_with(":0"),
        "{endpoints:?}"
    );
    publish(&mut output, &Arc::new(random_snapshot(10, 1, 1, 1)));
    let snapshot = Arc::new(random_snapshot(6000, 7, 1, 2));
    publish(&mut output, &snapshot);

    let session = client("", &endpoints[0]);
    let received = ask(&session, "0/splat_mapper/**").expect("no snapshot");
    assert!(received == *snapshot);
    let folder = tempfile::tempdir().unwrap();
    let paths = [
        folder.path().join("sent.ply"),
        folder.path().join("received.ply"),
    ];
    save_map(MapFile::Ply(&snapshot.splats), &paths[0]).unwrap();
    save_map(MapFile::Ply(&received.splats), &paths[1]).unwrap();
    assert!(std::fs::read(&paths[0]).unwrap() == std::fs::read(&paths[1]).unwrap());

    // The path alone, by its own key: in a robot's axes.
    let replies = session.get("0/splat_mapper/path/*/*").wait().unwrap();
    let paths: Vec<Path> = replies
        .into_iter()
        .map(|r| ros::decode(&r.into_result().unwrap().payload().to_bytes()).unwrap())
        .collect();
    assert_eq!((paths.len(), paths[0].poses.len()), (1, 7));
    let last = odometry::forward_camera() * snapshot.poses[6].world_from_cam;
    let reported = paths[0].poses[6].pose.to_rigid().unwrap();
    assert!(
        (reported.translation - last.translation).length() < 1e-9
            && reported.angle_to(&last) < 1e-9
    );
    output.handles.publisher.close().unwrap();
}

#[test]
fn a_subscriber_that_was_there_first_receives_every_revision() {
    let endpoint = free_endpoint();
    let session = client(&endpoint, "");
    let live = session
        .declare_subscriber("7/robot/mapper/**")
        .wait()
        .unwrap();
    let mut params = params("");
    params.zenoh_connect = endpoint;
    params.namespace = "robot/mapper".to_owned();
    params.domain_id = 7;
    let mut output = Output::open(&params, Vec::new()).unwrap();
    assert!(output.handles.publisher.endpoints().is_empty());
    // Publishing begins when the peers know each other.
    let matching = session
        .liveliness()
        .declare_subscriber("@ros2_lv/7/**")
        .history(true)
        .wait()
        .unwrap();
    // One of the node, and those of its publishers and services, in any order. One that is declared while the history is
    // asked for may come twice.
    let n_tokens = 1 + topics().len() + SERVICES.len();
    let mut tokens = BTreeSet::new();
    while tokens.len() < n_tokens {
        let token = matching.recv_timeout(PATIENCE).unwrap().expect("no token");
        tokens.insert(token.key_expr().to_string());
    }
    let name = "/%/%robot/mapper";
    assert!(
        tokens.iter().all(|token: &String| token.contains(name)),
        "{tokens:?}"
    );
    assert!(
        tokens
            .iter()
            .any(|token| token.contains("/%robot%mapper%splats%manifest/splat_mapper_msgs::msg")),
        "{tokens:?}"
    );

    let snapshots: Vec<Arc<Snapshot>> = (1..4)
        .map(|revision| Arc::new(random_snapshot(3000, 3, 1, revision)))
        .collect();
    let mut assembler = Assembler::new(MAX_BYTES);
    for snapshot in &snapshots {
        publish(&mut output, snapshot);
        let received =
            std::iter::repeat_with(|| live.recv_timeout(PATIENCE).unwrap().expect("silence"))
                .find_map(|sample| {
                    let attachment = sample.attachment().unwrap().to_bytes();
                    assert_eq!((attachment.len(), attachment[16]), (33, 16));
                    take(&mut assembler, &sample)
                });
        assert!(received.as_ref() == Some(&**snapshot));
    }
    output.handles.publisher.close().unwrap();
}

#[test]
fn a_peer_that_sends_noise_to_our_keys_harms_nobody() {
    let mut output = Output::open(&params("tcp/127.0.0.1:0"), Vec::new()).unwrap();
    let session = client("", &output.handles.publisher.endpoints()[0]);
    let snapshot = Arc::new(random_snapshot(2000, 3, 1, 2));
    publish(&mut output, &snapshot);
    ask(&session, "0/splat_mapper/**").expect("no snapshot");
    for ix in 0..200_u32 {
        session
            .put("0/splat_mapper/splats/manifest/x/y", vec![0xff; 1000])
            .wait()
            .unwrap();
        // Answers nobody reads.
        drop(
            session
                .get("0/splat_mapper/**")
                .payload(ix.to_le_bytes().to_vec())
                .wait()
                .unwrap(),
        );
    }
    assert!(ask(&session, "0/splat_mapper/**").as_ref() == Some(&*snapshot));
    output.handles.publisher.close().unwrap();
}

/// A wire between a client and `endpoint` that can be stalled: bytes towards the client then stay where they are.
struct Wire {
    endpoint: String,
    stalled: Arc<AtomicBool>,
}

impl Wire {
    fn new(endpoint: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let wire = Self {
            endpoint: format!("tcp/{}", listener.local_addr().unwrap()),
            stalled: Arc::default(),
        };
        let (address, stalled) = (
            endpoint.strip_prefix("tcp/").unwrap().to_owned(),
            Arc::clone(&wire.stalled),
        );
        let named = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let carry = move || {
            let (near, _) = listener.accept().unwrap();
            let far = TcpStream::connect(address).unwrap();
            let (mut near_in, mut far_out) = (near.try_clone().unwrap(), far.try_clone().unwrap());
            named("wire-out")
                .spawn(move || std::io::copy(&mut near_in, &mut far_out))
                .unwrap();
            let (mut far, mut near, mut bytes) = (far, near, [0; 4096]);
            while let Ok(n @ 1..) = far.read(&mut bytes) {
                near.write_all(&bytes[..n]).unwrap();
                while stalled.load(Ordering::Relaxed) {
                    std::thread::park_timeout(Duration::from_millis(20));
                }
            }
        };
        named("wire-in").spawn(carry).unwrap();
        wire
    }
}

#[test]
fn a_peer_that_takes_nothing_in_is_cut_off_and_others_go_on() {
    let mut output = Output::open(&params("tcp/127.0.0.1:0"), Vec::new()).unwrap();
    let endpoint = output.handles.publisher.endpoints().remove(0);
    // 18 MB each: more than all buffers on the way hold.
    let snapshot = |revision| Arc::new(random_snapshot(60_000, 3, 3, revision));
    publish(&mut output, &snapshot(1));
    let wire = Wire::new(&endpoint);
    let stuck = client("", &wire.endpoint);
    let _stuck_live = stuck
        .declare_subscriber("0/splat_mapper/**")
        .wait()
        .unwrap();
    ask(&stuck, "0/splat_mapper/**").expect("no snapshot before the stall");
    let session = client("", &endpoint);
    let live = session
        .declare_subscriber("0/splat_mapper/**")
        .wait()
        .unwrap();
    ask(&session, "0/splat_mapper/**").expect("no snapshot for the healthy one");
    wire.stalled.store(true, Ordering::Relaxed);

    let started = Stopwatch::start();
    let last = snapshot(4);
    let received = std::thread::scope(|scope| {
        let receiver = scope.spawn(|| {
            let mut assembler = Assembler::new(MAX_BYTES);
            std::iter::repeat_with(|| live.recv_timeout(PATIENCE).unwrap().expect("silence"))
                .filter_map(|sample| take(&mut assembler, &sample))
                .find(|snapshot| snapshot.revision == 4)
        });
        [snapshot(2), snapshot(3), Arc::clone(&last)]
            .iter()
            .for_each(|s| publish(&mut output, s));
        receiver.join().unwrap()
    });
    assert!(received.as_ref() == Some(&*last));
    assert!(
        started.secs() > 1.5,
        "{} s: nothing stalled, so nothing was tested",
        started.secs()
    );
    // zenoh lingers ten seconds over bytes that the stalled peer never took; we do not.
    let closing = Stopwatch::start();
    let closed = output.handles.publisher.close();
    assert!(
        closing.secs() < 2.5 && matches!(closed, Ok(()) | Err(PublishError::Close { .. })),
        "{closed:?}"
    );
    wire.stalled.store(false, Ordering::Relaxed);
}

#[test]
fn a_peer_that_starts_after_the_mapper_is_found() {
    let endpoint = free_endpoint();
    let mut params = params("");
    params.zenoh_connect = endpoint.clone();
    let started = Stopwatch::start();
    let mut output = Output::open(&params, Vec::new()).unwrap();
    let snapshot = Arc::new(random_snapshot(100, 2, 1, 1));
    publish(&mut output, &snapshot);
    assert!(
        started.secs() < 5.0,
        "{} s with nobody there",
        started.secs()
    );
    assert!(ask(&client(&endpoint, ""), "0/splat_mapper/**").as_ref() == Some(&*snapshot));
    output.handles.publisher.close().unwrap();
}

#[test]
fn close_without_peers_is_quick() {
    let output = Output::open(&params("tcp/127.0.0.1:0"), Vec::new()).unwrap();
    let started = Stopwatch::start();
    output.handles.publisher.close().unwrap();
    assert!(started.secs() < 2.0, "{} s", started.secs());
}

#[test]
fn a_zenoh_configuration_file_stands_for_the_endpoints() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("zenoh.json5");
    let endpoint = free_endpoint();
    let text = format!(
        "{{ listen: {{ endpoints: [{endpoint:?}] }}, scouting: {{ multicast: {{ enabled: false }} }} }}"
    );
    std::fs::write(&path, text).unwrap();
    let mut params = params("nonsense that nobody reads");
    params.zenoh_config = path.display().to_string();
    let mut output = Output::open(&params, Vec::new()).unwrap();
    assert_eq!(
        output.handles.publisher.endpoints(),
        std::slice::from_ref(&endpoint)
    );
    let snapshot = Arc::new(random_snapshot(20, 1, 0, 1));
    publish(&mut output, &snapshot);
    assert!(ask(&client("", &endpoint), "0/splat_mapper/**").as_ref() == Some(&*snapshot));
    output.handles.publisher.close().unwrap();

    std::fs::write(&path, "{ listen: ").unwrap();
    let fault = Output::open(&params, Vec::new()).unwrap_err().to_string();
    assert!(
        fault.contains("publish.zenoh_config") && fault.ends_with("zenoh.json5"),
        "{fault}"
    );
}

#[test]
fn errors_name_the_parameter() {
    let message =
        |params: PublishParams| Output::open(&params, Vec::new()).unwrap_err().to_string();
    for bad in ["nonsense", "tcp/127.0.0.1", "warp/127.0.0.1:7447"] {
        let found = message(params(bad));
        assert!(found.contains("zenoh_listen"), "{bad}: {found}");
    }
    let mut bad = params("");
    bad.namespace = "a*b".to_owned();
    assert!(message(bad).contains("publish.namespace"));
    let mut bad = params("");
    bad.zenoh_config = "/nowhere/zenoh.json5".to_owned();
    assert!(message(bad).contains("publish.zenoh_config"));
    // A port that is taken.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = format!("tcp/{}", listener.local_addr().unwrap());
    let fault = Output::open(&params(&taken), Vec::new()).unwrap_err();
    assert!(
        matches!(fault, PublishError::Open { .. }) && fault.to_string().contains(&taken),
        "{fault}"
    );
}
