//! The lifecycle of a managed node by hand, as r2r has none: its services, its event, and what each step does.
//!
//! Active maps; inactive keeps the map and looks at no image; to clean up is to throw the map away; to shut down ends
//! the input, as Ctrl-C does.

use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};

use r2r::lifecycle_msgs::msg::{State, Transition, TransitionDescription, TransitionEvent};
use r2r::lifecycle_msgs::srv::{
    ChangeState, GetAvailableStates, GetAvailableTransitions, GetState,
};
use r2r::{Publisher, QosProfile};

use crate::ros2::error::LinkError;
use crate::ros2::node::Link;
use crate::ros2::services::{Job, ServiceHandler, listen, respond, trigger};

/// Where the node stands, numbered as in `lifecycle_msgs/msg/State`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LifecycleState {
    Unconfigured = 1,
    Inactive = 2,
    Active = 3,
    Finalized = 4,
}

/// What a step makes the mapper do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Deed {
    Map,
    Pause,
    /// Throws the map away, and pauses.
    Forget,
    End,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Step {
    /// As in `lifecycle_msgs/msg/Transition`.
    id: u8,
    label: &'static str,
    from: LifecycleState,
    to: LifecycleState,
    deed: Deed,
}

const fn step(
    id: u8,
    label: &'static str,
    from: LifecycleState,
    to: LifecycleState,
    deed: Deed,
) -> Step {
    Step {
        id,
        label,
        from,
        to,
        deed,
    }
}

const STEPS: [Step; 7] = [
    step(
        1,
        "configure",
        LifecycleState::Unconfigured,
        LifecycleState::Inactive,
        Deed::Pause,
    ),
    step(
        2,
        "cleanup",
        LifecycleState::Inactive,
        LifecycleState::Unconfigured,
        Deed::Forget,
    ),
    step(
        3,
        "activate",
        LifecycleState::Inactive,
        LifecycleState::Active,
        Deed::Map,
    ),
    step(
        4,
        "deactivate",
        LifecycleState::Active,
        LifecycleState::Inactive,
        Deed::Pause,
    ),
    step(
        5,
        "shutdown",
        LifecycleState::Unconfigured,
        LifecycleState::Finalized,
        Deed::End,
    ),
    step(
        6,
        "shutdown",
        LifecycleState::Inactive,
        LifecycleState::Finalized,
        Deed::End,
    ),
    step(
        7,
        "shutdown",
        LifecycleState::Active,
        LifecycleState::Finalized,
        Deed::End,
    ),
];

impl LifecycleState {
    const ALL: [Self; 4] = [
        Self::Unconfigured,
        Self::Inactive,
        Self::Active,
        Self::Finalized,
    ];

    fn label(self) -> &'static str {
        match self {
            Self::Unconfigured => "unconfigured",
            Self::Inactive => "inactive",
            Self::Active => "active",
            Self::Finalized => "finalized",
        }
    }

    fn message(self) -> State {
        State {
            id: self as u8,
            label: self.label().to_owned(),
        }
    }

    /// A label goes before a number, as in rclcpp: tools send either.
    fn step(self, asked: &Transition) -> Option<Step> {
        STEPS.into_iter().find(|step| {
            step.from == self
                && if asked.label.is_empty() {
                    step.id == asked.id
                } else {
                    step.label == asked.label
                }
        })
    }
}

impl Step {
    fn message(self) -> Transition {
        Transition {
            id: self.id,
            label: self.label.to_owned(),
        }
    }

    fn description(self) -> TransitionDescription {
        TransitionDescription {
            transition: self.message(),
            start_state: self.from.message(),
            goal_state: self.to.message(),
        }
    }
}

/// What the steps act on.
#[derive(Clone)]
pub struct Hands {
    pub service_server: ServiceHandler,
    /// Ends the input.
    pub end: Arc<dyn Fn() + Send + Sync>,
}

impl std::fmt::Debug for Hands {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Hands")
    }
}

impl Hands {
    /// Whether the mapper did it.
    fn act(&self, deed: Deed) -> bool {
        match deed {
            Deed::Map => trigger(&self.service_server, "resume"),
            Deed::Pause => trigger(&self.service_server, "pause"),
            Deed::Forget => {
                trigger(&self.service_server, "reset") && trigger(&self.service_server, "pause")
            }
            Deed::End => {
                (self.end)();
                true
            }
        }
    }
}

/// Where the node stands, for the services and the steps, which run on the thread that answers.
#[derive(Clone)]
struct Lifecycle {
    place: Arc<Mutex<LifecycleState>>,
    events: Publisher<TransitionEvent>,
    hands: Hands,
}

impl Lifecycle {
    fn place(&self) -> LifecycleState {
        *self.place.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the step exists from here and was made.
    fn change(&self, asked: &Transition) -> bool {
        let from = self.place();
        let Some(step) = from.step(asked) else {
            tracing::warn!(
                "the lifecycle has no step {} {:?} from {}",
                asked.id,
                asked.label,
                from.label()
            );
            return false;
        };
        if !self.hands.act(step.deed) {
            return false;
        }
        *self.place.lock().unwrap_or_else(PoisonError::into_inner) = step.to;
        tracing::info!("lifecycle: {} -> {}", from.label(), step.to.label());
        let event = TransitionEvent {
            transition: step.message(),
            start_state: from.message(),
            goal_state: step.to.message(),
            ..TransitionEvent::default()
        };
        if let Err(e) = self.events.publish(&event) {
            tracing::debug!("a step of the lifecycle was not reported: {e}");
        }
        true
    }
}

/// Offers the services. With `autostart` the node is active at once, else it waits for whoever manages it.
pub(crate) fn offer(
    link: &Link,
    hands: Hands,
    jobs: &SyncSender<Job>,
    autostart: bool,
) -> Result<(), LinkError> {
    let events = link.ask("a publisher of \"transition_event\"", |spun| {
        let qos = QosProfile::default();
        spun.node.create_publisher("~/transition_event", qos)
    })?;
    let place = if autostart {
        LifecycleState::Active
    } else {
        LifecycleState::Unconfigured
    };
    if !autostart && !hands.act(Deed::Pause) {
        tracing::warn!("the mapper does not pause before the lifecycle activates it");
    }
    let lifecycle = Lifecycle {
        place: Arc::new(Mutex::new(place)),
        events,
        hands,
    };
    let (of, jobs) = (lifecycle.clone(), jobs.clone());
    listen::<ChangeState::Service>(link, "change_state", move |request| {
        let of = of.clone();
        let job: Job = Box::new(move || {
            let success = of.change(&request.message.transition);
            respond(request, ChangeState::Response { success }, "change_state");
        });
        if jobs.try_send(job).is_err() {
            tracing::warn!("too many questions wait: a step of the lifecycle is left out");
        }
    })?;
    let of = lifecycle.clone();
    listen::<GetState::Service>(link, "get_state", move |request| {
        let current_state = of.place().message();
        respond(request, GetState::Response { current_state }, "get_state");
    })?;
    listen::<GetAvailableStates::Service>(link, "get_available_states", move |request| {
        let available_states = LifecycleState::ALL.map(LifecycleState::message).to_vec();
        let response = GetAvailableStates::Response { available_states };
        respond(request, response, "get_available_states");
    })?;
    // Tools ask either for the steps from here or for the whole graph, by services of the same type.
    let of = lifecycle;
    listen::<GetAvailableTransitions::Service>(
        link,
        "get_available_transitions",
        move |request| {
            let here = of.place();
            let steps = STEPS.into_iter().filter(|step| step.from == here);
            let available_transitions = steps.map(Step::description).collect();
            let response = GetAvailableTransitions::Response {
                available_transitions,
            };
            respond(request, response, "get_available_transitions");
        },
    )?;
    listen::<GetAvailableTransitions::Service>(link, "get_transition_graph", move |request| {
        let available_transitions = STEPS.map(Step::description).to_vec();
        let response = GetAvailableTransitions::Response {
            available_transitions,
        };
        respond(request, response, "get_transition_graph");
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(id: u8, label: &str) -> Transition {
        Transition {
            id,
            label: label.to_owned(),
        }
    }

    #[test]
    fn a_manager_can_walk_up_and_down() {
        let mut place = LifecycleState::Unconfigured;
        for (id, expected) in [
            (1, LifecycleState::Inactive),
            (3, LifecycleState::Active),
            (4, LifecycleState::Inactive),
            (2, LifecycleState::Unconfigured),
            (5, LifecycleState::Finalized),
        ] {
            place = place.step(&asked(id, "")).unwrap().to;
            assert_eq!(place, expected);
        }
        assert!(
            STEPS
                .iter()
                .all(|step| step.from != LifecycleState::Finalized)
        );
    }

    #[test]
    fn steps_from_elsewhere_are_refused_and_labels_fit_every_place() {
        assert_eq!(LifecycleState::Active.step(&asked(1, "")), None);
        assert_eq!(LifecycleState::Active.step(&asked(0, "dance")), None);
        for place in [
            LifecycleState::Unconfigured,
            LifecycleState::Inactive,
            LifecycleState::Active,
        ] {
            let step = place.step(&asked(0, "shutdown")).unwrap();
            assert_eq!((step.to, step.deed), (LifecycleState::Finalized, Deed::End));
        }
    }
}
