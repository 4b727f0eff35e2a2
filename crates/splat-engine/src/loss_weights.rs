//! Weights of the terms of the loss: each is declared here once, for the settings of a step, for both backends, for the
//! shaders, for the tests that prove its gradient, and as a parameter of whoever trains with it.

use bytemuck::{Pod, Zeroable};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A field of `LossWeights`, and of `Step` in `shaders/lib/step.wgsl`, for each term.
macro_rules! loss_weights {
    ($($(#[$attribute:meta])* $name:ident,)*) => {
        /// Weights of the terms that are added to the photometric loss; 0 turns a term off. What serde writes are the mapper's
        /// parameters `train.*`, with these texts; a decay over the run is the mapper's.
        #[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, Serialize, Deserialize, JsonSchema)]
        #[repr(C)]
        pub struct LossWeights {
            $($(#[$attribute])* #[schemars(range(min = 0.0, max = 100.0))] pub $name: f32,)*
        }

        impl LossWeights {
            /// Names of the terms, in order.
            pub const NAMES: &[&str] = &[$(stringify!($name)),*];

            /// Every term at the same weight.
            pub const fn all(weight: f32) -> Self {
                Self { $($name: weight),* }
            }

            /// One term alone.
            pub const fn only(term_ix: usize, weight: f32) -> Self {
                let mut weights = Self::all(0.0);
                let mut ix = 0;
                $(
                    if ix == term_ix {
                        weights.$name = weight;
                    }
                    ix += 1;
                )*
                assert!(term_ix < ix, "no term has this number");
                weights
            }
        }

        /// The fields that `#import loss_weights` puts into `Step`.
        pub(crate) const WGSL_FIELDS: &str =
            concat!($("    ", stringify!($name), ": f32,\n"),*);
    };
}

loss_weights! {
    /// Weight of the depth loss; decays to a tenth over the run.
    depth_weight,
    /// Weight of the mean opacity over the visible splats, or over all with `all_splats` (3DGS-MCMC regulariser); the mapper's `mcmc.opacity_reg`.
    #[serde(skip)]
    opacity_reg,
    /// Weight of the mean scale over the same splats, per world unit (3DGS-MCMC regulariser); the mapper's `mcmc.scale_reg`.
    #[serde(skip)]
    scale_reg,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_term_alone_is_the_one_of_that_name() {
        for (ix, name) in LossWeights::NAMES.iter().enumerate() {
            let weights = LossWeights::only(ix, 3.0);
            let text = format!("{weights:?}");
            assert!(text.contains(&format!("{name}: 3.0")), "{text}");
            assert_eq!(text.matches("3.0").count(), 1, "{text}");
            assert!(WGSL_FIELDS.contains(&format!("{name}: f32,")));
        }
    }
}
