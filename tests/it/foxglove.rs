//! What Foxglove gets: every topic with its definition, what was latched before it came, and bytes as they went out.

use std::collections::BTreeMap;
use std::net::TcpStream;
use std::time::Duration;

use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use splat_ros::output::{Output, topics};
use splat_ros::params::PublishParams;
use splat_ros::transport::{Delivery, Sample, Topic};
use splat_types::time::Stamp;

const PATIENCE: Duration = Duration::from_secs(20);
/// Of the protocol: a message of a subscription.
const MESSAGE_DATA: u8 = 1;

struct Studio {
    socket: WebSocket<MaybeTlsStream<TcpStream>>,
    /// By topic.
    channels: BTreeMap<String, Value>,
}

impl Studio {
    fn connect(address: &str, n_channels: usize) -> Self {
        let mut request = address.into_client_request().unwrap();
        let protocol = "foxglove.sdk.v1".parse().unwrap();
        request
            .headers_mut()
            .insert("Sec-WebSocket-Protocol", protocol);
        let (mut socket, _) = tungstenite::connect(request).expect("connects");
        let MaybeTlsStream::Plain(stream) = socket.get_mut() else {
            panic!("encrypted")
        };
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut channels = BTreeMap::new();
        while channels.len() < n_channels {
            let Message::Text(text) = socket.read().expect("advertisements") else {
                continue;
            };
            let said: Value = serde_json::from_str(&text).unwrap();
            if said["op"] == "advertise" {
                for channel in said["channels"].as_array().unwrap() {
                    let topic = channel["topic"].as_str().unwrap().to_owned();
                    channels.insert(topic, channel.clone());
                }
            }
        }
        Self { socket, channels }
    }

    /// Subscriptions have the ids of channels.
    fn subscribe_to_all(&mut self) {
        let ids = self.channels.values().map(|channel| &channel["id"]);
        let all: Vec<Value> = ids.map(|id| json!({"id": id, "channelId": id})).collect();
        let ask = json!({"op": "subscribe", "subscriptions": all});
        self.socket
            .send(Message::Text(ask.to_string().into()))
            .unwrap();
    }

    /// Topic, time and bytes of the next message.
    fn next(&mut self) -> (String, u64, Vec<u8>) {
        loop {
            let Message::Binary(bytes) = self.socket.read().expect("a message") else {
                continue;
            };
            if bytes[0] != MESSAGE_DATA {
                continue;
            }
            let id = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
            let nanos = u64::from_le_bytes(bytes[5..13].try_into().unwrap());
            let mut channels = self.channels.iter();
            let (topic, _) = channels.find(|(_, channel)| channel["id"] == id).unwrap();
            return (topic.clone(), nanos, bytes[13..].to_vec());
        }
    }
}

fn shown_name(topic: &Topic) -> String {
    if topic.name.starts_with('/') {
        topic.name.to_owned()
    } else {
        format!("/robot/{}", topic.name)
    }
}

fn sample(topic: &'static Topic, n: u8) -> Sample {
    Sample {
        topic,
        stamp: Stamp {
            nanos: 1_000 + i64::from(n),
        },
        payload: vec![0, 1, 0, 0, n].into(),
    }
}

fn served() -> Output {
    let params = PublishParams {
        foxglove: "127.0.0.1:0".to_owned(),
        namespace: "robot".to_owned(),
        ..PublishParams::default()
    };
    Output::open(&params, Vec::new()).unwrap()
}

#[test]
fn foxglove_gets_all_topics_and_what_was_latched_before_it_came() {
    let output = served();
    let publisher = &output.handles.publisher;
    let address = publisher.endpoints().pop().unwrap();
    let all = topics();
    let send = |n: u8| {
        for topic in &all {
            publisher.send(&sample(topic, n)).unwrap();
        }
    };
    (1..=3).for_each(send);
    let mut studio = Studio::connect(&address, all.len());
    for topic in &all {
        let channel = &studio.channels[&shown_name(topic)];
        let of = |key: &str| channel[key].as_str().unwrap_or_default();
        assert_eq!((of("encoding"), of("schemaEncoding")), ("cdr", "ros2msg"));
        assert_eq!(
            (of("schemaName"), of("schema")),
            (topic.type_name, topic.definition)
        );
    }
    studio.subscribe_to_all();
    let mut expected = Vec::new();
    for topic in &all {
        if let Delivery::Latched { depth } = topic.delivery {
            let kept = (1..=3).skip(3_usize.saturating_sub(depth));
            expected.extend(
                kept.map(|n: u8| (shown_name(topic), 1_000 + u64::from(n), vec![0, 1, 0, 0, n])),
            );
        }
    }
    let mut found: Vec<_> = expected.iter().map(|_| studio.next()).collect();
    found.sort();
    expected.sort();
    assert!(!expected.is_empty());
    assert_eq!(found, expected);
    send(4);
    let mut found: Vec<_> = all.iter().map(|_| studio.next()).collect();
    found.sort();
    let mut expected: Vec<_> = all
        .iter()
        .map(|topic| (shown_name(topic), 1_004, vec![0, 1, 0, 0, 4]))
        .collect();
    expected.sort();
    assert_eq!(found, expected);
    publisher.close().unwrap();
}

#[test]
fn a_foxglove_address_of_no_use_is_an_error_that_says_what_is_expected() {
    for address in ["8765", "127.0.0.1:port", "203.0.113.7:8765"] {
        let params = PublishParams {
            foxglove: address.to_owned(),
            ..PublishParams::default()
        };
        let error = Output::open(&params, Vec::new()).err().unwrap().to_string();
        assert!(
            error.contains("foxglove") && error.contains(address),
            "{error}"
        );
    }
}

#[test]
fn a_client_that_never_reads_holds_nobody_up() {
    let output = served();
    let publisher = &output.handles.publisher;
    let topic = topics().into_iter().find(|t| t.name == "cloud").unwrap();
    publisher.send(&sample(topic, 1)).unwrap();
    let mut studio = Studio::connect(&publisher.endpoints().pop().unwrap(), 1);
    studio.subscribe_to_all();
    studio.next();
    let big = Sample {
        payload: vec![0; 1 << 16].into(),
        ..sample(topic, 2)
    };
    // Four times what may wait, and more than sockets hold.
    for _ in 0..4 * 1024 {
        publisher.send(&big).unwrap();
    }
    publisher.close().unwrap();
}

/// All strings of a JSON value that name a topic of ours, as far as it has a name of its own.
fn topics_in(value: &Value, found: &mut Vec<String>) {
    let mut note = |text: &str| {
        if text.starts_with("/splat_mapper/") || text == "/diagnostics" {
            found.push(text.to_owned());
        }
    };
    match value {
        Value::String(text) => note(text),
        Value::Array(values) => values.iter().for_each(|value| topics_in(value, found)),
        Value::Object(fields) => {
            fields.keys().for_each(|key| note(key));
            fields.values().for_each(|value| topics_in(value, found));
        }
        _ => {}
    }
}

fn panels_in(layout: &Value, found: &mut Vec<String>) {
    match layout {
        Value::String(panel) => found.push(panel.clone()),
        _ => ["first", "second"]
            .iter()
            .for_each(|side| panels_in(&layout[side], found)),
    }
}

#[test]
fn the_layout_that_is_shipped_shows_topics_and_fields_that_there_are() {
    let text = std::fs::read_to_string("launch/foxglove_layout.json").unwrap();
    let layout: Value = serde_json::from_str(&text).unwrap();
    let mut panels = Vec::new();
    panels_in(&layout["layout"], &mut panels);
    panels.sort();
    let configured: Vec<&String> = layout["configById"].as_object().unwrap().keys().collect();
    assert_eq!(panels.iter().collect::<Vec<_>>(), configured);
    let mut named = Vec::new();
    topics_in(&layout["configById"], &mut named);
    assert!(named.len() > 8, "{named:?}");
    for name in named {
        let name = name.strip_prefix("/splat_mapper/").unwrap_or(&name);
        let (topic, field) = name.split_once('.').unwrap_or((name, ""));
        let all = topics();
        let topic = all.iter().find(|t| t.name == topic);
        let topic = topic.unwrap_or_else(|| panic!("no topic {name}"));
        let has_field = topic
            .definition
            .lines()
            .any(|line| line.split_whitespace().nth(1) == Some(field));
        assert!(field.is_empty() || has_field, "no field {name}");
    }
}
