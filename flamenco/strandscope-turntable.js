// SPDX-License-Identifier: GPL-3.0-or-later
// A job type of Flamenco (docs/flamenco.md): a film of the hair on the turntable, and pictures of it beside the photographs.

const JOB_TYPE = {
    label: "Strandscope: turntable",
    description: "Render found hair as it turns, and beside the photographs of its capture",
    settings: [
        { key: "capture", type: "string", subtype: "dir_path", required: true,
          description: "Folder of the capture; on storage that all workers see" },
        { key: "strands", type: "string", subtype: "file_path", required: true,
          description: "The strands file (.npz) that was found in it" },
        { key: "output_folder", type: "string", subtype: "dir_path", required: true,
          description: "Folder for the Blender file, the film and the comparison; on storage that all workers see" },
        { key: "frames", type: "string", default: "1-120",
          description: "Frames of the film to render; the hair turns once in 120. Nothing for no film" },
        { key: "chunk_size", type: "int32", default: 10, propargs: { min: 1 },
          description: "Number of frames that one task renders" },
        { key: "film_percent", type: "int32", default: 50, propargs: { min: 1 },
          description: "Size of the frames, in percent of the photographs' channel planes" },
        { key: "fps", type: "int32", default: 24, propargs: { min: 1 },
          description: "Frames a second of the film" },
        { key: "angles", type: "int32", default: 4, propargs: { min: 0 },
          description: "Photographs to compare with, evenly around the hair; 0 for no comparison" },
        { key: "size", type: "int32", default: 360, propargs: { min: 16 },
          description: "Pixels along the longer side of each picture of the comparison" },
        { key: "samples", type: "int32", default: 32, propargs: { min: 1 },
          description: "Rays a pixel, of film and comparison" },
        { key: "program", type: "string", choices: ["{strandscope}", "{blender}"], default: "{strandscope}", visible: "submission",
          description: "Variable of the program to run: Strandscope itself, or a Blender with its extension" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    const hair = { capture: place(settings, "capture"), strands: place(settings, "strands"), to: place(settings, "output_folder") };
    const angles = whole(settings, "angles", 4, 0);
    const frames = text(settings, "frames", "1-120");
    if (!frames && angles === 0) {
        wrong("frames", frames, "frames to render, or angles to compare with");
    }
    if (frames) {
        addFilm(job, hair, frames);
    }
    if (angles > 0) {
        addComparison(job, hair, angles);
    }
}

// A Blender file, its frames in chunks, and their film.
function addFilm(job, hair, frames) {
    const settings = job.settings;
    const name = path.stem(hair.strands);
    const file = inside(hair.to, name + ".blend");
    const folder = inside(hair.to, name + "_film");

    const blend = author.Task("blend", "blender");
    blend.addCommand(strandscope(settings, ["blend", hair.strands, file, "--capture", hair.capture]));
    job.addTask(blend);

    const film = author.Task("film", "ffmpeg");
    const set = "import bpy; scene = bpy.context.scene; scene.cycles.samples = " + whole(settings, "samples", 32, 1)
        + "; scene.render.resolution_percentage = " + whole(settings, "film_percent", 50, 1);
    for (const chunk of frameChunker(frames, whole(settings, "chunk_size", 10, 1))) {
        const render = author.Task("render " + chunk, "blender");
        render.addDependency(blend);
        render.addCommand(author.Command("blender-render", {
            exe: "{blender}",
            exeArgs: "{blenderArgs}",
            argsBefore: [],
            blendfile: file,
            args: ["--python-expr", set, "--render-output", inside(folder, "######"), "--render-format", "PNG",
                "--render-frame", chunk.replace(/-/g, "..")],
        }));
        job.addTask(render);
        film.addDependency(render);
    }
    film.addCommand(author.Command("frames-to-video", {
        exe: "ffmpeg",
        fps: whole(settings, "fps", 24, 1),
        inputGlob: inside(folder, "*.png"),
        outputFile: inside(hair.to, name + ".mp4"),
        args: ["-c:v", "h264", "-crf", "18", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-y"],
    }));
    job.addTask(film);
}

// Each picture in a task of its own, then all beside the photographs. The first makes the folder ready: the others wait for it.
function addComparison(job, hair, angles) {
    const settings = job.settings;
    const options = ["--angles", angles, "--size", whole(settings, "size", 360, 16), "--samples", whole(settings, "samples", 32, 1)].map(String);
    const folder = inside(hair.to, path.stem(hair.strands) + "_comparison");
    const verb = ["turntable", hair.capture, hair.strands, folder].concat(options);
    const compare = author.Task("compare", "blender");
    let first = null;
    for (let i = 1; i <= angles; i++) {
        const part = author.Task("picture " + i + " of " + angles, "blender");
        part.addCommand(strandscope(settings, verb.concat(["--part", i + "/" + angles])));
        if (first) {
            part.addDependency(first);
        }
        first = first || part;
        job.addTask(part);
        compare.addDependency(part);
    }
    compare.addCommand(strandscope(settings, verb));
    job.addTask(compare);
}

// ---- the same in both job types, for Flamenco loads each file alone --------------------------------------------------

// A command that runs a verb of Strandscope.
function strandscope(settings, args) {
    const program = oneOf(settings, "program", ["{strandscope}", "{blender}"]);
    const before = program === "{blender}" ? ["--command", "strandscope"] : [];
    return author.Command("exec", { exe: program, args: before.concat(args) });
}

// An absolute path. One that begins with // would be relative to the Blender file that the job is sent from.
function place(settings, key) {
    const value = text(settings, key, "");
    if (!/^([A-Za-z]:[\\/]|\/(?!\/)|\\\\|\{)/.test(value)) {
        wrong(key, value, "an absolute path that all workers see");
    }
    return value;
}

// A path in a folder. Not path.join, which takes a slash away from \\server.
function inside(folder, name) {
    return folder.replace(/[\\/]+$/, "") + "/" + name;
}

function text(settings, key, without) {
    const value = settings[key];
    return value === undefined || value === null ? without : String(value).trim();
}

function whole(settings, key, without, least) {
    const given = settings[key];
    const value = given === undefined || given === null ? without : Number(given);
    if (Math.floor(value) !== value || value < least) {
        wrong(key, given, "a whole number of at least " + least);
    }
    return value;
}

function oneOf(settings, key, choices) {
    const value = text(settings, key, choices[0]);
    if (choices.indexOf(value) < 0) {
        wrong(key, value, "one of " + choices.join(", "));
    }
    return value;
}

function wrong(key, value, expected) {
    throw new Error("setting " + key + " is " + JSON.stringify(value) + "; expected " + expected);
}
