//! Message definition -> the type hash of ROS 2 (RIHS01), which is part of every rmw_zenoh key.
//!
//! REP-2016: SHA-256 over the type's description as JSON: names and types of all fields, and of all types they
//! refer to; neither comments, constants nor default values. A wrong hash means silence, so it is computed from the
//! definition that travels, never written down.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use sha2::{Digest, Sha256};

use crate::ros::Message;

/// `type_description_interfaces/msg/FieldType`, as far as these messages need it.
const NESTED_TYPE: u32 = 1;
const PLAIN_TYPES: [(&str, u32); 14] = [
    ("int8", 2),
    ("uint8", 3),
    ("int16", 4),
    ("uint16", 5),
    ("int32", 6),
    ("uint32", 7),
    ("int64", 8),
    ("uint64", 9),
    ("float32", 10),
    ("float64", 11),
    ("char", 13),
    ("bool", 15),
    ("byte", 16),
    ("string", 17),
];
const ARRAY_OFFSET: u32 = 48;
const UNBOUNDED_SEQUENCE_OFFSET: u32 = 144;

const BOUNDED_SEQUENCE_OFFSET: u32 = 96;

const SERVICE_EVENT_INFO: &str = "MSG: service_msgs/ServiceEventInfo\nuint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number\n";
const TIME: &str = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

const SECTION_BREAK: &str =
    "================================================================================\n";

/// `RIHS01_` and 64 hexadecimal digits.
pub fn type_hash<T: Message>() -> String {
    hash_of(T::TYPE_NAME, T::DEFINITION)
}

/// The same by name and definition.
pub fn hash_of(type_name: &str, definition: &str) -> String {
    hashed(&description_json(type_name, definition))
}

/// Of a service, whose description refers to its question, its answer and what introspection says of both.
pub fn service_hash(type_name: &str, request: &str, response: &str) -> String {
    let bodies = [(request, "Request"), (response, "Response")].map(|(definition, part)| {
        let (root, rest) = definition
            .split_once(SECTION_BREAK)
            .unwrap_or((definition, ""));
        // Nothing is no structure: rosidl gives it one member.
        let is_empty = root
            .lines()
            .all(|line| line.split('#').next().is_some_and(|l| l.trim().is_empty()));
        let root = if is_empty {
            "uint8 structure_needs_at_least_one_member\n"
        } else {
            root
        };
        (format!("MSG: {type_name}_{part}\n{root}"), rest.to_owned())
    });
    let [(request, request_rest), (response, response_rest)] = bodies;
    let name = type_name;
    let root = format!(
        "{name}_Request request_message\n{name}_Response response_message\n{name}_Event event_message\n"
    );
    let event = format!(
        "MSG: {name}_Event\nservice_msgs/ServiceEventInfo info\n{name}_Request[<=1] request\n{name}_Response[<=1] response\n"
    );
    let sections: Vec<&str> = [
        root.as_str(),
        &request,
        &response,
        &event,
        SERVICE_EVENT_INFO,
        TIME,
        &request_rest,
        &response_rest,
    ]
    .into_iter()
    .filter(|section| !section.is_empty())
    .collect();
    hashed(&description_json(type_name, &sections.join(SECTION_BREAK)))
}

fn hashed(json: &str) -> String {
    Sha256::digest(json.as_bytes())
        .iter()
        .fold("RIHS01_".to_owned(), |mut text, byte| {
            write!(text, "{byte:02x}").expect("writing to a string cannot fail");
            text
        })
}

/// `geometry_msgs/msg/PoseStamped` -> `geometry_msgs::msg::dds_::PoseStamped_`, as keys spell types.
pub fn dds_type_name<T: Message>() -> String {
    dds_name(T::TYPE_NAME)
}

/// The same by name, of services as well.
pub fn dds_name(type_name: &str) -> String {
    let (package, rest) = type_name
        .split_once('/')
        .expect("a type name is package/kind/Name");
    let (kind, name) = rest
        .split_once('/')
        .expect("a type name is package/kind/Name");
    format!("{package}::{kind}::dds_::{name}_")
}

/// The definitions are our own constants: what they lack is our mistake, hence the panics.
fn description_json(type_name: &str, definition: &str) -> String {
    let mut sections = definition.split(SECTION_BREAK);
    let root = sections.next().expect("split yields one part");
    let types: BTreeMap<String, &str> = sections
        .map(|section| {
            let section = section
                .strip_prefix("MSG: ")
                .expect("a section begins with MSG:");
            let (name, body) = section.split_once('\n').expect("a section has a body");
            (full_name(name, ""), body)
        })
        .collect();
    let referenced: Vec<String> = types
        .iter()
        .map(|(name, body)| type_json(name, body, &types))
        .collect();
    format!(
        "{{\"type_description\": {}, \"referenced_type_descriptions\": [{}]}}",
        type_json(type_name, root, &types),
        referenced.join(", ")
    )
}

fn type_json(type_name: &str, body: &str, types: &BTreeMap<String, &str>) -> String {
    let package = type_name.split('/').next().unwrap_or_default();
    let mut fields = Vec::new();
    for line in body.lines() {
        let text = line.split('#').next().unwrap_or_default();
        let mut words = text.split_ascii_whitespace();
        let (Some(type_text), Some(name)) = (words.next(), words.next()) else {
            continue;
        };
        // A constant, not a field with a bound.
        if text.replace("<=", "").contains('=') {
            continue;
        }
        fields.push(format!(
            "{{\"name\": \"{name}\", \"type\": {}}}",
            field_type_json(type_text, package, types)
        ));
    }
    format!(
        "{{\"type_name\": \"{type_name}\", \"fields\": [{}]}}",
        fields.join(", ")
    )
}

fn field_type_json(type_text: &str, package: &str, types: &BTreeMap<String, &str>) -> String {
    let (element, brackets) = match type_text.split_once('[') {
        Some((element, rest)) => (
            element,
            Some(rest.strip_suffix(']').expect("an array type ends with ]")),
        ),
        None => (type_text, None),
    };
    let (offset, capacity) = match brackets {
        None => (0, 0),
        Some("") => (UNBOUNDED_SEQUENCE_OFFSET, 0),
        Some(bound) if bound.starts_with("<=") => (
            BOUNDED_SEQUENCE_OFFSET,
            bound[2..].parse::<u32>().expect("a bound is a number"),
        ),
        Some(count) => (
            ARRAY_OFFSET,
            count.parse::<u32>().expect("a length is a number"),
        ),
    };
    let plain = PLAIN_TYPES.iter().find(|(name, _)| *name == element);
    let (id, nested) = match plain {
        Some((_, id)) => (*id, String::new()),
        None => (NESTED_TYPE, full_name(element, package)),
    };
    assert!(
        nested.is_empty() || types.contains_key(&nested),
        "definition of {nested} is missing"
    );
    format!(
        "{{\"type_id\": {}, \"capacity\": {capacity}, \"string_capacity\": 0, \"nested_type_name\": \"{nested}\"}}",
        id + offset
    )
}

/// `std_msgs/Header` -> `std_msgs/msg/Header`; a bare name belongs to the package that uses it, a full one stays.
fn full_name(name: &str, package: &str) -> String {
    if name.matches('/').count() == 2 {
        return name.to_owned();
    }
    match name.split_once('/') {
        Some((package, name)) => format!("{package}/msg/{name}"),
        None => format!("{package}/msg/{name}"),
    }
}
