//! An image -> its features, of the kind that the parameters name.

use std::path::Path;

use crate::error::FeaturesError;
use crate::features::descriptor::Features;
use crate::features::params::{FeatureKind, FeatureParams};
use crate::features::scale_space::{Grey, SpareMemory};
use crate::features::xfeat::Xfeat;
use crate::features::{orb, sift};

/// Finds features of one kind.
#[derive(Debug)]
pub enum FeatureExtractor {
    Sift(SpareMemory),
    Orb,
    Xfeat(Box<Xfeat>),
}

impl FeatureExtractor {
    pub fn new(params: &FeatureParams) -> Result<Self, FeaturesError> {
        match params.kind {
            FeatureKind::Auto | FeatureKind::Sift => Ok(Self::Sift(SpareMemory::default())),
            FeatureKind::Orb => Ok(Self::Orb),
            FeatureKind::Xfeat if params.xfeat_model.is_empty() => Err(FeaturesError::NoModel),
            FeatureKind::Xfeat => {
                let network = Xfeat::open(Path::new(&params.xfeat_model))?;
                Ok(Self::Xfeat(Box::new(network)))
            }
        }
    }

    /// At most `max_features` points of an image. Images too small for the kind, and broken ones, have none.
    pub fn features(&self, image: &Grey, max_features: usize) -> Features {
        match self {
            Self::Sift(spare) => sift::features_within(spare, image, max_features),
            Self::Orb => orb::features(image, max_features),
            Self::Xfeat(network) => network.features(image, max_features),
        }
    }
}

#[cfg(test)]
#[cfg(test)]
mod tests;
