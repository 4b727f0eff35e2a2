//! Parameter services: all of `launch/params.yaml` can be listed, described and read; what is read at the start only is
//! refused with that reason.
//!
//! r2r has services of its own, but they know neither ranges nor read-only parameters.

use std::sync::Arc;

use r2r::rcl_interfaces::msg::{
    FloatingPointRange, IntegerRange, ListParametersResult, Parameter, ParameterDescriptor,
    ParameterEvent, ParameterValue, SetParametersResult,
};
use r2r::rcl_interfaces::srv::{
    DescribeParameters, GetParameterTypes, GetParameters, ListParameters, SetParameters,
    SetParametersAtomically,
};
use r2r::{Publisher, QosProfile};
use serde_json::Value;

use crate::config::live::Live;
use crate::config::{Range, Settings};
use crate::publish::ros2::services::{listen, respond};
use crate::source::ros2::link::{Link, LinkError};

/// Kinds of value, as `rcl_interfaces/msg/ParameterType` numbers them.
const NOT_SET: u8 = 0;
const BOOL: u8 = 1;
const INTEGER: u8 = 2;
const DOUBLE: u8 = 3;
const STRING: u8 = 4;

/// Offers the six services, and tells `/parameter_events` of changes.
pub(super) fn offer(link: &Link) -> Result<(), LinkError> {
    let live = &link.live;
    let of = Arc::clone(live);
    listen::<ListParameters::Service>(link, "list_parameters", move |request| {
        let result = listed(&of.keys(), &request.message.prefixes, request.message.depth);
        respond(
            request,
            ListParameters::Response { result },
            "list_parameters",
        );
    })?;
    let of = Arc::clone(live);
    listen::<GetParameters::Service>(link, "get_parameters", move |request| {
        let values = request.message.names.iter().map(|name| value_of(&of, name));
        let values = values.collect();
        respond(
            request,
            GetParameters::Response { values },
            "get_parameters",
        );
    })?;
    let of = Arc::clone(live);
    listen::<GetParameterTypes::Service>(link, "get_parameter_types", move |request| {
        let types = request.message.names.iter();
        let types = types.map(|name| value_of(&of, name).type_).collect();
        respond(
            request,
            GetParameterTypes::Response { types },
            "get_parameter_types",
        );
    })?;
    let of = Arc::clone(live);
    listen::<DescribeParameters::Service>(link, "describe_parameters", move |request| {
        let shipped = Settings::shipped();
        let names = request.message.names.iter();
        let descriptors = names.map(|name| described(&shipped, &of, name)).collect();
        respond(
            request,
            DescribeParameters::Response { descriptors },
            "describe_parameters",
        );
    })?;
    let events = Events::open(link)?;
    let (of, tell) = (Arc::clone(live), events.clone());
    listen::<SetParameters::Service>(link, "set_parameters", move |request| {
        // One by one, as the service is meant: what is fine is set although another is not.
        let parameters = request.message.parameters.iter();
        let results = parameters
            .map(|p| set(&of, std::slice::from_ref(p), &tell))
            .collect();
        respond(
            request,
            SetParameters::Response { results },
            "set_parameters",
        );
    })?;
    let (of, tell) = (Arc::clone(live), events);
    listen::<SetParametersAtomically::Service>(link, "set_parameters_atomically", move |request| {
        let result = set(&of, &request.message.parameters, &tell);
        let response = SetParametersAtomically::Response { result };
        respond(request, response, "set_parameters_atomically");
    })
}

/// Where changes are told.
#[derive(Clone)]
struct Events {
    publisher: Publisher<ParameterEvent>,
    node: String,
}

impl Events {
    fn open(link: &Link) -> Result<Self, LinkError> {
        let publisher = link.ask("a publisher of \"/parameter_events\"", |spun| {
            let qos = QosProfile::parameter_events();
            spun.node.create_publisher("/parameter_events", qos)
        })?;
        Ok(Self {
            publisher,
            node: link.names.full_name(),
        })
    }

    fn tell(&self, changed: &[Parameter]) {
        let event = ParameterEvent {
            node: self.node.clone(),
            changed_parameters: changed.to_vec(),
            ..ParameterEvent::default()
        };
        if let Err(e) = self.publisher.publish(&event) {
            tracing::debug!("a change of parameters was not told: {e}");
        }
    }
}

fn set(live: &Live, parameters: &[Parameter], events: &Events) -> SetParametersResult {
    let changes: Result<Vec<_>, String> = parameters
        .iter()
        .map(|p| json_of(&p.value).map(|value| (p.name.clone(), value)))
        .collect();
    let done = changes.and_then(|changes| live.set(&changes).map_err(|e| e.to_string()));
    match done {
        Ok(()) => {
            for parameter in parameters {
                tracing::info!("parameter {} is set", parameter.name);
            }
            events.tell(parameters);
            SetParametersResult {
                successful: true,
                reason: String::new(),
            }
        }
        Err(reason) => SetParametersResult {
            successful: false,
            reason,
        },
    }
}

fn json_of(value: &ParameterValue) -> Result<Value, String> {
    Ok(match value.type_ {
        BOOL => value.bool_value.into(),
        INTEGER => value.integer_value.into(),
        DOUBLE => value.double_value.into(),
        STRING => value.string_value.clone().into(),
        NOT_SET => return Err("parameters cannot be taken away".to_owned()),
        other => {
            return Err(format!(
                "a value of type {other}, expected bool, integer, double or string"
            ));
        }
    })
}

/// Unset for an unknown name.
fn value_of(live: &Live, name: &str) -> ParameterValue {
    let mut message = ParameterValue::default();
    match live.value(name) {
        Some(Value::Bool(value)) => {
            message.type_ = BOOL;
            message.bool_value = value;
        }
        Some(Value::Number(number)) => match number.as_i64() {
            Some(value) => {
                message.type_ = INTEGER;
                message.integer_value = value;
            }
            None => {
                message.type_ = DOUBLE;
                message.double_value = number.as_f64().unwrap_or(f64::NAN);
            }
        },
        Some(Value::String(value)) => {
            message.type_ = STRING;
            message.string_value = value;
        }
        _ => {}
    }
    message
}

fn described(shipped: &Settings, live: &Live, name: &str) -> ParameterDescriptor {
    let mut descriptor = ParameterDescriptor {
        name: name.to_owned(),
        type_: value_of(live, name).type_,
        ..ParameterDescriptor::default()
    };
    let Some(description) = shipped.describe(name) else {
        return descriptor;
    };
    descriptor.description = description.text;
    descriptor.read_only = !Live::is_live(name);
    match description.range {
        Range::Number { min, max } if description.is_whole => {
            descriptor.integer_range = vec![IntegerRange {
                from_value: min as i64,
                to_value: max as i64,
                step: 1,
            }];
        }
        Range::Number { min, max } => {
            descriptor.floating_point_range = vec![FloatingPointRange {
                from_value: min,
                to_value: max,
                step: 0.0,
            }];
        }
        Range::Choice(names) => {
            descriptor.additional_constraints = format!("one of {}", names.join(", "));
        }
        Range::Flag | Range::Text => {}
    }
    descriptor
}

/// Names below any of the prefixes, or all; at most `depth` levels below it, 0 for all levels.
fn listed(keys: &[String], prefixes: &[String], depth: u64) -> ListParametersResult {
    let levels = |text: &str| text.matches('.').count() as u64;
    let fits = |key: &str| {
        if prefixes.is_empty() {
            return depth == 0 || levels(key) < depth;
        }
        prefixes.iter().any(|prefix| {
            let rest = key.strip_prefix(prefix.as_str());
            rest.is_some_and(|rest| {
                rest.is_empty() || rest.starts_with('.') && (depth == 0 || levels(rest) <= depth)
            })
        })
    };
    let names: Vec<String> = keys.iter().filter(|key| fits(key)).cloned().collect();
    let mut prefixes: Vec<String> = names
        .iter()
        .filter_map(|name| name.rsplit_once('.'))
        .map(|(prefix, _)| prefix.to_owned())
        .collect();
    prefixes.dedup();
    ListParametersResult { names, prefixes }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_listed_by_prefix_and_depth() {
        let keys = ["a", "b.x", "b.y.z", "bc.x"].map(str::to_owned);
        let names = |prefixes: &[&str], depth| {
            let prefixes: Vec<String> = prefixes.iter().map(|&p| p.to_owned()).collect();
            listed(&keys, &prefixes, depth).names
        };
        assert_eq!(names(&[], 0), keys);
        assert_eq!(names(&[], 1), ["a"]);
        assert_eq!(names(&["b"], 0), ["b.x", "b.y.z"]);
        assert_eq!(names(&["b"], 1), ["b.x"]);
        assert_eq!(names(&["a", "b.y"], 0), ["a", "b.y.z"]);
    }

    #[test]
    fn ranges_and_meanings_are_described() {
        let live = Live::new(Settings::shipped());
        let shipped = Settings::shipped();
        let steps = described(&shipped, &live, "map.steps");
        assert!(steps.read_only && steps.type_ == INTEGER);
        assert_eq!(steps.integer_range[0].to_value, 10_000_000);
        let silence = described(&shipped, &live, "ros2.silence_secs");
        assert!(!silence.read_only && silence.type_ == DOUBLE);
        assert_eq!(silence.floating_point_range[0].from_value, 0.1);
        assert!(!silence.description.is_empty());
        assert_eq!(described(&shipped, &live, "nothing").type_, NOT_SET);
    }
}
