// A piece of a function: pixel j of a run of `ssim_maps_load`, blurred.
        var p = vec3<f32>(0.0);
        var q = vec3<f32>(0.0);
        var r = vec3<f32>(0.0);
#repeat t 11
        p += WINDOW[$t] * p_$[j+t];
        q += WINDOW[$t] * q_$[j+t];
        r += WINDOW[$t] * r_$[j+t];
#end
