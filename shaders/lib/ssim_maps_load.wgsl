// A piece of a function: the three `maps` of SSIM's gradient at the 4 pixels of a run and those that the window reaches.
// `first` is the run's first pixel along its row or column, which has `n_along` pixels, the first of them at `start` and
// each `stride` behind the one before; `plane` pixels make a map.
#repeat t 14
    var p_$t = vec3<f32>(0.0);
    var q_$t = vec3<f32>(0.0);
    var r_$t = vec3<f32>(0.0);
    {
        let along = first + $t - REACH;
        if along >= 0 && along < n_along {
            let at = start + u32(along) * stride;
            p_$t = maps[at].xyz;
            q_$t = maps[plane + at].xyz;
            r_$t = maps[2u * plane + at].xyz;
        }
    }
#end
