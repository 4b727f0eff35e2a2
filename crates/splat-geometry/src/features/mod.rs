//! Images -> keypoints with descriptors: SIFT, ORB, or XFeat through ONNX Runtime.

pub mod params;

pub mod scale_space;

pub mod descriptor;

pub mod orb;

pub mod sift;

pub mod xfeat;

pub mod extractor;
