//! Parameter services: all of `launch/params.yaml` can be listed, described and read; a change of what is read at the start
//! only is refused with that reason.
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

use crate::ros2::error::LinkError;
use crate::ros2::node::Link;
use crate::ros2::parameter_store::{Descriptor, ParameterStore, Range};
use crate::ros2::services::{listen, respond};

/// Kinds of value, as `rcl_interfaces/msg/ParameterType` numbers them.
const NOT_SET: u8 = 0;
const BOOL: u8 = 1;
const INTEGER: u8 = 2;
const DOUBLE: u8 = 3;
const STRING: u8 = 4;

/// Offers the six services, and reports `/parameter_events` of changes.
pub(crate) fn offer(link: &Link, store: &Arc<dyn ParameterStore>) -> Result<(), LinkError> {
    let of = Arc::clone(store);
    listen::<ListParameters::Service>(link, "list_parameters", move |request| {
        let keys: Vec<String> = of.list().into_iter().map(|found| found.key).collect();
        let result = listed(&keys, &request.message.prefixes, request.message.depth);
        respond(
            request,
            ListParameters::Response { result },
            "list_parameters",
        );
    })?;
    let of = Arc::clone(store);
    listen::<GetParameters::Service>(link, "get_parameters", move |request| {
        let values = request
            .message
            .names
            .iter()
            .map(|name| value_of(&*of, name));
        let values = values.collect();
        respond(
            request,
            GetParameters::Response { values },
            "get_parameters",
        );
    })?;
    let of = Arc::clone(store);
    listen::<GetParameterTypes::Service>(link, "get_parameter_types", move |request| {
        let types = request.message.names.iter();
        let types = types.map(|name| value_of(&*of, name).type_).collect();
        respond(
            request,
            GetParameterTypes::Response { types },
            "get_parameter_types",
        );
    })?;
    let of = Arc::clone(store);
    listen::<DescribeParameters::Service>(link, "describe_parameters", move |request| {
        let all = of.list();
        let names = request.message.names.iter();
        let descriptors = names.map(|name| described(&all, &*of, name)).collect();
        respond(
            request,
            DescribeParameters::Response { descriptors },
            "describe_parameters",
        );
    })?;
    let events = Events::open(link)?;
    let (of, send_latched) = (Arc::clone(store), events.clone());
    listen::<SetParameters::Service>(link, "set_parameters", move |request| {
        // One by one, as the service is meant: what is fine is set although another is not.
        let parameters = request.message.parameters.iter();
        let results = parameters
            .map(|p| set(&*of, std::slice::from_ref(p), &send_latched))
            .collect();
        respond(
            request,
            SetParameters::Response { results },
            "set_parameters",
        );
    })?;
    let (of, send_latched) = (Arc::clone(store), events);
    listen::<SetParametersAtomically::Service>(link, "set_parameters_atomically", move |request| {
        let result = set(&*of, &request.message.parameters, &send_latched);
        let response = SetParametersAtomically::Response { result };
        respond(request, response, "set_parameters_atomically");
    })
}

/// Where changes are reported.
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

    fn send_latched(&self, changed: &[Parameter]) {
        let event = ParameterEvent {
            node: self.node.clone(),
            changed_parameters: changed.to_vec(),
            ..ParameterEvent::default()
        };
        if let Err(e) = self.publisher.publish(&event) {
            tracing::debug!("a change of parameters was not reported: {e}");
        }
    }
}

fn set(
    store: &dyn ParameterStore,
    parameters: &[Parameter],
    events: &Events,
) -> SetParametersResult {
    let changes: Result<Vec<_>, String> = parameters
        .iter()
        .map(|p| json_of(&p.value).map(|value| (p.name.clone(), value)))
        .collect();
    let done = changes.and_then(|changes| store.set(&changes));
    match done {
        Ok(()) => {
            for parameter in parameters {
                tracing::info!("parameter {} is set", parameter.name);
            }
            events.send_latched(parameters);
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
fn value_of(store: &dyn ParameterStore, name: &str) -> ParameterValue {
    let mut message = ParameterValue::default();
    match store.get(name) {
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

fn described(all: &[Descriptor], store: &dyn ParameterStore, name: &str) -> ParameterDescriptor {
    let mut descriptor = ParameterDescriptor {
        name: name.to_owned(),
        type_: value_of(store, name).type_,
        ..ParameterDescriptor::default()
    };
    let Some(known) = all.iter().find(|known| known.key == name) else {
        return descriptor;
    };
    let unit = known.unit.as_ref().map(|unit| format!("{unit}. "));
    descriptor.description = unit.unwrap_or_default() + &known.text;
    descriptor.read_only = !known.is_live;
    match known.range {
        Range::Number {
            min,
            max,
            is_whole: true,
        } => {
            descriptor.integer_range = vec![IntegerRange {
                from_value: min as i64,
                to_value: max as i64,
                step: 1,
            }];
        }
        Range::Number { min, max, .. } => {
            descriptor.floating_point_range = vec![FloatingPointRange {
                from_value: min,
                to_value: max,
                step: 0.0,
            }];
        }
        Range::Choice(ref names) => {
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

    /// One whole number that is read at the start only, and one that may change.
    struct Two;

    impl ParameterStore for Two {
        fn list(&self) -> Vec<Descriptor> {
            let of = |key: &str, is_whole, is_live| Descriptor {
                key: key.to_owned(),
                range: Range::Number {
                    min: 0.5,
                    max: 1000.0,
                    is_whole,
                },
                unit: Some("s".to_owned()),
                text: "Time.".to_owned(),
                is_live,
            };
            vec![of("steps", true, false), of("timeout", false, true)]
        }

        fn get(&self, key: &str) -> Option<Value> {
            match key {
                "steps" => Some(7.into()),
                "timeout" => Some(7.5.into()),
                _ => None,
            }
        }

        fn set(&self, _changes: &[(String, Value)]) -> Result<(), String> {
            Err("nothing can be set".to_owned())
        }
    }

    #[test]
    fn ranges_and_meanings_are_described() {
        let all = Two.list();
        let steps = described(&all, &Two, "steps");
        assert!(steps.read_only && steps.type_ == INTEGER);
        assert_eq!(steps.integer_range[0].to_value, 1000);
        let timeout = described(&all, &Two, "timeout");
        assert!(!timeout.read_only && timeout.type_ == DOUBLE);
        assert_eq!(timeout.floating_point_range[0].from_value, 0.5);
        assert_eq!(timeout.description, "s. Time.");
        assert_eq!(described(&all, &Two, "nothing").type_, NOT_SET);
    }
}
