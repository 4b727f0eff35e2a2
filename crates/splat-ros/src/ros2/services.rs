//! Services: each question leaves the node's thread as CDR and comes back answered, from a thread that may wait.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use r2r::splat_mapper_msgs::srv::{
    Export, GetDistanceBox, GetDistances, GetEllipsoids, GetMesh, GetSplats, LoadMap, RenderView,
    SaveMap,
};
use r2r::std_srvs::srv::Trigger;
use r2r::{QosProfile, ServiceRequest, WrappedServiceTypeSupport, WrappedTypesupport};

use crate::ros2::error::LinkError;
use crate::ros2::node::Link;
use splat_msgs::services::{Kind, SERVICES};

/// Questions that wait for the thread that answers.
const MAX_WAITING: usize = 8;

/// Name of a service and its question as CDR -> the answer as CDR. May wait for seconds; never fails.
pub type ServiceHandler = Arc<dyn Fn(&'static str, &[u8]) -> Vec<u8> + Send + Sync>;

pub(crate) type Job = Box<dyn FnOnce() + Send>;

/// The thread that answers; ends when the last sender of jobs is gone.
pub(crate) fn spawn_handler() -> Result<SyncSender<Job>, std::io::Error> {
    let (jobs, taken): (SyncSender<Job>, Receiver<Job>) = sync_channel(MAX_WAITING);
    std::thread::Builder::new()
        .name("ros2-services".to_owned())
        .spawn(move || {
            while let Ok(job) = taken.recv() {
                job();
            }
        })?;
    Ok(jobs)
}

/// Offers the services of the mapper. The same service server serves all.
pub(crate) fn offer(
    link: &Link,
    service_server: &ServiceHandler,
    jobs: &SyncSender<Job>,
) -> Result<(), LinkError> {
    SERVICES.iter().try_for_each(|service| {
        let name = service.name;
        match service.kind {
            Kind::SaveMap => serve::<SaveMap::Service>(link, name, service_server, jobs),
            Kind::LoadMap => serve::<LoadMap::Service>(link, name, service_server, jobs),
            Kind::Export => serve::<Export::Service>(link, name, service_server, jobs),
            Kind::Reset | Kind::Pause | Kind::Resume => {
                serve::<Trigger::Service>(link, name, service_server, jobs)
            }
            Kind::GetSplats => serve::<GetSplats::Service>(link, name, service_server, jobs),
            Kind::RenderView => serve::<RenderView::Service>(link, name, service_server, jobs),
            Kind::GetDistances => serve::<GetDistances::Service>(link, name, service_server, jobs),
            Kind::GetDistanceBox => {
                serve::<GetDistanceBox::Service>(link, name, service_server, jobs)
            }
            Kind::GetEllipsoids => {
                serve::<GetEllipsoids::Service>(link, name, service_server, jobs)
            }
            Kind::GetMesh => serve::<GetMesh::Service>(link, name, service_server, jobs),
        }
    })
}

fn serve<T>(
    link: &Link,
    name: &'static str,
    service_server: &ServiceHandler,
    jobs: &SyncSender<Job>,
) -> Result<(), LinkError>
where
    T: WrappedServiceTypeSupport + 'static,
    T::Request: Send,
    T::Response: Send,
{
    let (service_server, jobs) = (Arc::clone(service_server), jobs.clone());
    listen::<T>(link, name, move |request| {
        let service_server = Arc::clone(&service_server);
        let job: Job = Box::new(move || {
            let response = answered::<T>(&request.message, name, &service_server);
            respond(request, response, name);
        });
        if jobs.try_send(job).is_err() {
            tracing::warn!("{MAX_WAITING} questions wait: one to {name} is left without an answer");
        }
    })
}

/// Calls `take` with each request of a service, on the node's thread.
pub(crate) fn listen<T>(
    link: &Link,
    name: &'static str,
    mut take: impl FnMut(ServiceRequest<T>) + Send + 'static,
) -> Result<(), LinkError>
where
    T: WrappedServiceTypeSupport + 'static,
{
    link.ask(&format!("the service {name:?}"), move |spun| {
        let qos = QosProfile::services_default();
        let requests = spun.node.create_service::<T>(&format!("~/{name}"), qos)?;
        spun.drain(requests, move |request| {
            take(request);
            true
        });
        Ok(())
    })
}

pub(crate) fn respond<T>(request: ServiceRequest<T>, response: T::Response, name: &str)
where
    T: WrappedServiceTypeSupport + 'static,
{
    // The client, or the node, may be gone.
    if let Err(e) = request.respond(response) {
        tracing::debug!("an answer of {name} was not sent: {e}");
    }
}

fn answered<T: WrappedServiceTypeSupport>(
    question: &T::Request,
    name: &'static str,
    service_server: &ServiceHandler,
) -> T::Response {
    let answer = question
        .to_serialized_bytes()
        .and_then(|question| T::Response::from_serialized_bytes(&service_server(name, &question)));
    // Both sides are our own definitions.
    answer.unwrap_or_else(|e| {
        tracing::warn!("an answer of {name} was lost: {e}");
        T::Response::default()
    })
}

/// Asks the service server for one of the services without arguments; says whether it was done.
pub(crate) fn trigger(service_server: &ServiceHandler, name: &'static str) -> bool {
    answered::<Trigger::Service>(&Trigger::Request::default(), name, service_server).success
}
