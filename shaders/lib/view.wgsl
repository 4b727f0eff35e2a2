// What the engine keeps of a view, and of all views together. Mirrored by splat/wgpu/types.rs.

// Places of one view's numbers, and how many there are.
const VIEW_QUAT: u32 = 0u;
const VIEW_TRANSLATION: u32 = 4u;
const VIEW_PINHOLE: u32 = 8u;
// Log gain and offset of r, g, b.
const VIEW_EXPOSURE: u32 = 12u;
const VIEW_POSE_M: u32 = 18u;
const VIEW_POSE_V: u32 = 24u;
const VIEW_POSE_AGE: u32 = 30u;
const VIEW_EXPOSURE_AGE: u32 = 31u;
const VIEW_EXPOSURE_M: u32 = 32u;
const VIEW_EXPOSURE_V: u32 = 38u;
// cam_from_world as the last step used it: rotation by columns, translation.
const VIEW_NOW: u32 = 44u;
const VIEW_EMBEDDING_AGE: u32 = 56u;
const VIEW_APPEARANCE_AGE: u32 = 57u;
const VIEW_EMBEDDING: u32 = 64u;
const VIEW_EMBEDDING_M: u32 = 128u;
const VIEW_EMBEDDING_V: u32 = 192u;
const VIEW_APPEARANCE: u32 = 256u;
const VIEW_APPEARANCE_M: u32 = 272u;
const VIEW_APPEARANCE_V: u32 = 288u;
const VIEW_STRIDE: u32 = 320u;

// The shared network (3R-GS): parameters, first moments, second moments, then what else is shared.
const NET_SIZE: u32 = 8905u;
const NET_AGE: u32 = 26715u;
const LOG_FOCAL: u32 = 26716u;
const LOG_FOCAL_M: u32 = 26717u;
const LOG_FOCAL_V: u32 = 26718u;
const LOG_FOCAL_AGE: u32 = 26719u;
// The appearance network: parameters, first and second moments, age. Numbers of a view's embedding.
const N_APPEARANCE: u32 = 16u;
const APPEARANCE_NET: u32 = 26720u;
const APPEARANCE_NET_AGE: u32 = 43634u;
