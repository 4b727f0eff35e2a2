use crate::optim::pose_graph::*;

/// Round a circle, one node every few degrees, looking along it.
fn circle(n: usize) -> Vec<Similarity> {
    let node = |i: usize| {
        let angle = std::f64::consts::TAU * i as f64 / n as f64;
        Similarity {
            scale: 1.0,
            rotation: DQuat::from_rotation_z(angle),
            translation: DVec3::new(angle.cos(), angle.sin(), 0.1 * angle.sin()) * 3.0,
        }
    };
    (0..n).map(node).collect()
}

fn edge(nodes: &[Similarity], first: usize, second: usize, is_doubtful: bool) -> Edge {
    Edge {
        first,
        second,
        first_from_second: nodes[first].inverse() * nodes[second],
        std: [0.02, 0.01, 0.01],
        is_doubtful,
    }
}

/// The circle as it looks with each step a little too long, turned and large.
fn drifted(truth: &[Similarity]) -> Graph {
    let wrong = Similarity {
        scale: 1.004,
        rotation: DQuat::from_scaled_axis(DVec3::new(0.002, -0.001, 0.003)),
        translation: DVec3::new(0.002, 0.001, -0.001),
    };
    let mut nodes = vec![truth[0]];
    let mut edges = Vec::new();
    for i in 1..truth.len() {
        let mut step = edge(truth, i - 1, i, false);
        step.first_from_second = step.first_from_second * wrong;
        nodes.push(nodes[i - 1] * step.first_from_second);
        edges.push(step);
    }
    let is_held = (0..truth.len()).map(|i| i == 0).collect();
    Graph {
        nodes,
        is_held,
        edges,
        moves_scale: true,
    }
}

fn error(graph: &Graph, truth: &[Similarity]) -> f64 {
    let squares = graph
        .nodes
        .iter()
        .zip(truth)
        .map(|(a, b)| (a.translation - b.translation).length_squared());
    (squares.sum::<f64>() / truth.len() as f64).sqrt()
}

#[test]
fn a_closed_loop_takes_most_of_the_drift() {
    let truth = circle(80);
    let mut graph = drifted(&truth);
    let before = error(&graph, &truth);
    for i in 0..3 {
        graph.edges.push(edge(&truth, i, 79 - i, true));
    }
    let relaxed = graph.relax(50);
    let after = error(&graph, &truth);
    assert!(
        relaxed.cost_after < 0.3 * relaxed.cost_before,
        "{relaxed:?}"
    );
    assert!(after < 0.2 * before, "{after} of {before}");
    assert_eq!(graph.nodes[0], truth[0], "the first is held");
    assert!((graph.nodes[79].scale - 1.0).abs() < 0.02);
}

#[test]
fn edges_that_agree_move_nothing_and_one_that_is_far_off_little() {
    let truth = circle(40);
    let mut graph = drifted(&truth);
    let before = graph.nodes.clone();
    graph.relax(10);
    for (a, b) in graph.nodes.iter().zip(&before) {
        assert!(a.translation.distance(b.translation) < 1e-6);
    }
    let mut graph = Graph {
        nodes: truth.clone(),
        ..drifted(&truth)
    };
    graph.edges = (1..40).map(|i| edge(&truth, i - 1, i, false)).collect();
    graph.edges.push(edge(&truth, 0, 39, false));
    let mut wrong = edge(&truth, 5, 25, true);
    wrong.first_from_second.translation += DVec3::new(3.0, -4.0, 1.0);
    graph.edges.push(wrong);
    graph.relax(50);
    assert!(error(&graph, &truth) < 0.05, "{}", error(&graph, &truth));
    assert!(graph.misfit(&wrong) > 50.0);
}

#[test]
fn a_known_unit_stays() {
    let truth = circle(30);
    let mut graph = drifted(&truth);
    for (node, truth) in graph.nodes.iter_mut().zip(&truth) {
        node.scale = truth.scale;
    }
    graph
        .edges
        .iter_mut()
        .for_each(|t| t.first_from_second.scale = 1.0);
    graph.edges.push(edge(&truth, 0, 29, true));
    graph.moves_scale = false;
    let before = error(&graph, &truth);
    graph.relax(50);
    assert!(graph.nodes.iter().all(|n| n.scale == 1.0));
    assert!(error(&graph, &truth) < 0.5 * before);
}
