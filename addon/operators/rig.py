"""Photographing hair with a rig: the buttons. Each asks a process for something; pressed, it does not wait; called, it does."""

import bpy
from bpy.props import EnumProperty, IntProperty

from ...core.errors import StrandscopeError
from ...core.rig import attach
from .. import pictures, rig
from ..jobs import redraw

VIRTUAL_SPEED = 4.0  # while it is moved by hand


class _Asks(bpy.types.Operator):
    """What the operators here have in common: ``ask`` begins, ``hear`` waits for what came of it, where a script calls."""

    bl_options = {"INTERNAL"}

    def execute(self, context):
        try:
            self.ask(context)
            self.hear(context)
        except StrandscopeError as error:
            return self._failed(error)
        return {"FINISHED"}

    def invoke(self, context, _event):
        if bpy.app.background:
            return self.execute(context)
        try:
            self.ask(context)
        except StrandscopeError as error:
            return self._failed(error)
        rig.tick()
        redraw(context)
        return {"FINISHED"}

    def hear(self, context):
        """Nothing to wait for."""

    def _failed(self, error: StrandscopeError):
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}


class _Commands(_Asks):
    """Those that are a command to the hand."""

    def ask(self, context):
        rig.desk.hand.say(self.command(context))

    def hear(self, _context):
        hand, number = rig.desk.hand, len(rig.desk.hand.asked)
        rig.wait(lambda: len(hand.answers) >= number or rig.desk.hand is not hand)
        if rig.desk.hand is not hand:
            raise StrandscopeError(rig.desk.error or "the rig is not connected any more")
        if hand.answers[number - 1]:
            raise StrandscopeError(hand.answers[number - 1])


def _settings(context):
    return context.scene.strandscope_rig


def _connected(cls) -> bool:
    if rig.desk.hand and rig.desk.hand.connected:
        return True
    cls.poll_message_set("Wait until it is connected" if rig.desk.hand else "Connect the rig first")
    return False


def _still(cls) -> bool:
    """Connected, there, and with nothing going on."""
    if not _connected(cls):
        return False
    hand = rig.desk.hand
    if hand.state == "lost":
        cls.poll_message_set("The controller does not answer; look at its cable and power")
        return False
    if hand.busy not in ("", "live on", "live off") or hand.state in ("moving", "homing"):
        cls.poll_message_set("The rig is moving; wait, or stop it")
        return False
    return True


class STRANDSCOPE_OT_rig_ports(_Asks):
    """Look which serial ports there are, for the list of the field beside"""

    bl_idname = "strandscope.rig_ports"
    bl_label = "Find Ports"

    def ask(self, _context):
        rig.seek_ports()

    def hear(self, _context):
        rig.wait(lambda: rig.desk.seeking is None)


class STRANDSCOPE_OT_rig_connect(_Asks):
    """Connect the controller and the camera, to home, frame and focus"""

    bl_idname = "strandscope.rig_connect"
    bl_label = "Connect"

    @classmethod
    def poll(cls, context):
        settings = _settings(context)
        if rig.desk.running:
            cls.poll_message_set("A capture is running, and holds the rig")
        elif rig.desk.hand:
            cls.poll_message_set("It is connected already")
        elif settings.kind == "FILE" and settings.file_error:
            cls.poll_message_set("The rig file cannot be read, see above")
        elif settings.kind == "FILE" and not settings.file and not settings.port:
            cls.poll_message_set("Choose a rig file, or a port")
        else:
            return True
        return False

    def ask(self, context):
        settings = _settings(context)
        if settings.kind == "VIRTUAL":
            rig.connect(["--virtual", "--style", settings.style, "--scale", settings.scale, "--speed", str(VIRTUAL_SPEED)])
            return
        port = ["--port", settings.port] if settings.port else []
        rig.connect([*([str(settings.file_path)] if settings.file else []), *port])

    def hear(self, context):
        rig.wait(lambda: not rig.desk.hand or (rig.desk.hand.connected and rig.desk.hand.place is not None))
        if not rig.desk.hand:
            raise StrandscopeError(rig.desk.error)
        show_plan(context)


class STRANDSCOPE_OT_rig_disconnect(_Asks):
    """Halt the rig, and let go of it"""

    bl_idname = "strandscope.rig_disconnect"
    bl_label = "Disconnect"

    @classmethod
    def poll(cls, _context):
        cls.poll_message_set("It is not connected")
        return rig.desk.hand is not None

    def ask(self, _context):
        rig.disconnect()

    def hear(self, _context):
        rig.wait(lambda: rig.desk.hand is None)


class STRANDSCOPE_OT_rig_home(_Commands):
    """Find the position with the switches. The stage and the turntable move to their ends"""

    bl_idname = "strandscope.rig_home"
    bl_label = "Home"

    @classmethod
    def poll(cls, _context):
        return _still(cls)

    def command(self, _context):
        return "home"


class STRANDSCOPE_OT_rig_unlock(_Commands):
    """Take back the alarm without homing, so that the stage can be jogged away from where it is stuck"""

    bl_idname = "strandscope.rig_unlock"
    bl_label = "Unlock"

    @classmethod
    def poll(cls, _context):
        if not _still(cls):
            return False
        cls.poll_message_set("There is no alarm")
        return rig.desk.hand.state == "alarm"

    def command(self, _context):
        return "unlock"


class STRANDSCOPE_OT_rig_jog(_Commands):
    """Move by one step. It needs no homing"""

    bl_idname = "strandscope.rig_jog"
    bl_label = "Jog"

    axis: EnumProperty(items=(("FOCUS", "Focus", "The stage of the camera"), ("TURN", "Turn", "The turntable")), options={"SKIP_SAVE"})
    way: IntProperty(default=1, min=-1, max=1, options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context, properties):
        if properties.axis == "TURN":
            return "Turn the hair on" if properties.way > 0 else "Turn the hair back"
        return "Move the plane of focus towards the camera" if properties.way > 0 else "Move the plane of focus away from the camera"

    @classmethod
    def poll(cls, _context):
        if not _still(cls):
            return False
        cls.poll_message_set("The controller is locked; home, or unlock it")
        return rig.desk.hand.state != "alarm"

    def command(self, context):
        settings = _settings(context)
        return f"turn {self.way * float(settings.turn_deg):g}" if self.axis == "TURN" else f"jog {self.way * float(settings.jog_mm):g}"


class STRANDSCOPE_OT_rig_go(_Commands):
    """Go to a side of the hair, or focus on the axis"""

    bl_idname = "strandscope.rig_go"
    bl_label = "Go"

    to: EnumProperty(items=(("AXIS", "Axis", ""), ("NEAR", "Near Side", ""), ("FAR", "Far Side", ""), ("FRONT", "0°", "")), options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context, properties):
        return {
            "AXIS": "Focus on the axis of the turntable",
            "NEAR": "Focus where sweeps end",
            "FAR": "Focus where sweeps begin",
            "FRONT": "Turn the hair to the first angle",
        }[properties.to]

    @classmethod
    def poll(cls, _context):
        if not _still(cls):
            return False
        cls.poll_message_set("Home first: nobody knows where the rig stands")
        return rig.desk.hand.known

    def command(self, context):
        settings, here = _settings(context), rig.desk.hand.place
        if self.to == "FRONT":
            return f"go {plan_of(context).angles_deg[0]:.4f} {here.position_mm:.4f}"
        mm = {"AXIS": 0.0, "NEAR": settings.near_mm, "FAR": settings.far_mm}[self.to]
        return f"go {here.angle_deg:.4f} {mm:.4f}"


class STRANDSCOPE_OT_rig_stop(_Commands):
    """Halt at once, and keep the position"""

    bl_idname = "strandscope.rig_stop"
    bl_label = "Stop"

    @classmethod
    def poll(cls, _context):
        return _connected(cls)

    def command(self, _context):
        return "stop"


class STRANDSCOPE_OT_rig_live(_Commands):
    """Show what the camera sees, and how sharp it is"""

    bl_idname = "strandscope.rig_live"
    bl_label = "Live Picture"

    @classmethod
    def poll(cls, _context):
        if not _connected(cls):
            return False
        cls.poll_message_set(rig.desk.hand.camera or "Wait until the camera is connected, or look at its own screen")
        return rig.desk.hand.can_see

    def command(self, _context):
        return "live off" if rig.desk.hand.live else "live on"

    def hear(self, context):
        super().hear(context)
        if rig.desk.hand.live:
            rig.wait(lambda: not rig.desk.hand or rig.desk.hand.picture is not None or not rig.desk.hand.live)


class STRANDSCOPE_OT_rig_picture(bpy.types.Operator):
    """Show the picture in a window of its own, as large as you like"""

    bl_idname = "strandscope.rig_picture"
    bl_label = "Enlarge"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, _context):
        cls.poll_message_set("There is no picture yet")
        return picture() is not None

    def execute(self, context):
        try:
            pictures.show(context, picture())
        except RuntimeError as error:
            self.report({"ERROR"}, " ".join(str(error).split()))
            return {"CANCELLED"}
        return {"FINISHED"}


class STRANDSCOPE_OT_rig_mark(bpy.types.Operator):
    """Sweeps go as far as the plane of focus is now"""

    bl_idname = "strandscope.rig_mark"
    bl_label = "Set Here"
    bl_options = {"INTERNAL", "UNDO"}

    side: EnumProperty(items=(("NEAR", "Near Side", ""), ("FAR", "Far Side", "")), options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context, properties):
        return f"Sweeps {'end' if properties.side == 'NEAR' else 'begin'} where the plane of focus is now"

    @classmethod
    def poll(cls, _context):
        if not _connected(cls):
            return False
        cls.poll_message_set("Home first: nobody knows where the rig stands")
        return rig.desk.hand.known

    def execute(self, context):
        setattr(_settings(context), "near_mm" if self.side == "NEAR" else "far_mm", rig.desk.hand.place.position_mm)
        return {"FINISHED"}


class STRANDSCOPE_OT_rig_start(_Asks):
    """Take the photographs, in a process of its own: Blender can be used meanwhile, and closed. Homes first"""

    bl_idname = "strandscope.rig_start"
    bl_label = "Start Capture"

    @classmethod
    def poll(cls, context):
        settings = _settings(context)
        if rig.desk.running:
            cls.poll_message_set("A capture is running")
        elif not settings.folder:
            cls.poll_message_set("Choose a folder for the photographs")
        elif settings.begun and settings.complete:
            cls.poll_message_set("All photographs of this capture are there; choose another folder, or repeat a sweep")
        elif settings.begun:
            return True
        elif not (rig.desk.hand and rig.desk.hand.connected):
            cls.poll_message_set("Connect the rig first")
        elif fault := plan_fault(context):
            cls.poll_message_set(fault)
        else:
            return True
        return False

    def ask(self, context):
        settings = _settings(context)
        folder = settings.folder_path
        if settings.begun:
            rig.start(folder, ["--speed", f"{settings.speed:g}"])
            return
        virtual = settings.kind == "VIRTUAL"
        file, port = (None, "") if virtual else (settings.file_path, settings.port)
        asked = rig.write_asked(folder, plan_of(context), file, port, settings.name)
        hair = ["--virtual", "--style", settings.style, "--scale", settings.scale, "--speed", f"{settings.speed:g}"]
        rig.start(folder, [str(asked), *(hair if virtual else [])])

    def hear(self, _context):
        hear_of_start()


class STRANDSCOPE_OT_rig_order(_Asks):
    """Ask the capture that is running"""

    bl_idname = "strandscope.rig_order"
    bl_label = "Order"

    what: EnumProperty(items=((attach.PAUSE, "Pause", ""), (attach.RESUME, "Resume", ""), (attach.ABORT, "End", "")), options={"SKIP_SAVE"})

    @classmethod
    def description(cls, _context, properties):
        return {
            attach.PAUSE: "Halt after this photograph, until you resume. Do not touch the hair",
            attach.RESUME: "Go on taking photographs",
            attach.ABORT: "End the capture after this photograph. It can be gone on with",
        }[properties.what]

    @classmethod
    def poll(cls, _context):
        cls.poll_message_set("Wait until the capture has begun" if rig.desk.running else "No capture is running")
        return rig.desk.run is not None and attach.runs(rig.desk.run.folder)

    def ask(self, _context):
        rig.desk.run.order(self.what)

    def hear(self, _context):
        run = rig.desk.run
        obeyed = {attach.PAUSE: lambda: run.state == "paused", attach.RESUME: lambda: run.state != "paused", attach.ABORT: lambda: not run.running}
        rig.wait(lambda: obeyed[self.what]() or not run.running)


class STRANDSCOPE_OT_rig_repeat(_Asks):
    """Take a sweep anew: now if a capture is running, else in a new run. Its photographs so far are put aside"""

    bl_idname = "strandscope.rig_repeat"
    bl_label = "Repeat Sweep"

    @classmethod
    def poll(cls, context):
        if rig.desk.running and not (rig.desk.run and attach.runs(rig.desk.run.folder)):
            cls.poll_message_set("Wait until the capture has begun")
            return False
        cls.poll_message_set("There is no capture in this folder")
        return rig.desk.running or bool(_settings(context).begun)

    def invoke(self, context, event):
        if bpy.app.background:
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self, event, title=f"Take sweep {_settings(context).sweep} anew?", message="Its photographs so far are put aside.", confirm_text="Repeat"
        )

    def execute(self, context):
        try:
            self.ask(context)
            if bpy.app.background:
                self.hear(context)
        except StrandscopeError as error:
            return self._failed(error)
        return {"FINISHED"}

    def ask(self, context):
        settings = _settings(context)
        if rig.desk.running:
            rig.desk.run.order(attach.REPEAT, sweep=settings.sweep)
        else:
            rig.start(settings.folder_path, ["--repeat-sweep", str(settings.sweep), "--speed", f"{settings.speed:g}"])

    def hear(self, _context):
        hear_of_start()


class STRANDSCOPE_OT_rig_dismiss(bpy.types.Operator):
    """Put away what the last capture told"""

    bl_idname = "strandscope.rig_dismiss"
    bl_label = "Close"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, _context):
        cls.poll_message_set("It is still running")
        return not rig.desk.running

    def execute(self, context):
        rig.desk.run, rig.desk.error = None, ""
        redraw(context)
        return {"FINISHED"}


# ---- what they and the panel share -----------------------------------------------------------------------------------


def hear_of_start() -> None:
    """Wait until a capture has begun, or has failed to. Raises StrandscopeError with why."""
    rig.wait(lambda: rig.desk.then is None and (not rig.desk.run or not rig.desk.run.running or bool(rig.desk.run.told)))
    failed = rig.desk.error or (rig.desk.run and not rig.desk.run.running and rig.desk.run.message)
    if failed:
        raise StrandscopeError(failed)


def show_plan(context) -> None:
    """Show the plan of the rig that was connected in the fields, once."""
    settings, hand = _settings(context), rig.desk.hand
    if hand and hand.plan and not settings.planned:
        settings.take(hand.plan)


def plan_of(context):
    """The plan that the fields describe. Raises StrandscopeError."""
    s, hand = _settings(context), rig.desk.hand
    base = hand.plan if hand and hand.plan else rig.Plan()
    camera = {"shutter_s": round(s.shutter_s, 6), "f_number": round(s.f_number, 3), "iso": s.iso, "check_shots": s.check_shots}
    return rig.with_fields(base, s.angles, s.far_mm, s.near_mm, s.step_mm, **camera)


def plan_fault(context) -> str:
    """Why the plan cannot be taken, empty if it can."""
    try:
        plan = plan_of(context)
    except StrandscopeError as error:
        return str(error)
    free = rig.free_bytes(_settings(context).folder_path) if _settings(context).folder else None
    need = rig.cost(plan)[2]
    if free is not None and free < need:
        return f"The photographs need {need / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free there"
    return ""


def picture():
    """The file of the picture that is shown now: what the camera sees, or the last photograph."""
    for path in (rig.desk.run.picture if rig.desk.run else None, rig.desk.hand.picture if rig.desk.hand else None):
        if path and path.is_file():
            return path
    return None


def catch_up() -> float:
    """The timer: take in what the processes said, and show it. Returns seconds to the next time."""
    context = bpy.context
    settings = _settings(context)
    changed = rig.tick(*([settings.folder_path] if settings.folder else []), *rig.remembered())
    show_plan(context)
    run = rig.desk.run
    if run and rig.desk.running and not settings.folder:
        settings.folder = str(run.folder)
    if run and not rig.desk.running and not run.handed_over:
        run.handed_over, changed = True, True
        settings.folder = settings.folder  # how far it is
        if (run.folder / "capture.json").is_file():
            context.scene.strandscope.capture_path = str(run.folder)
    if changed:
        pictures.refresh(picture())
        redraw(context)
    return rig.BUSY_S if rig.desk.hand or rig.desk.running or rig.desk.seeking else rig.IDLE_S


CLASSES = (
    STRANDSCOPE_OT_rig_ports,
    STRANDSCOPE_OT_rig_connect,
    STRANDSCOPE_OT_rig_disconnect,
    STRANDSCOPE_OT_rig_home,
    STRANDSCOPE_OT_rig_unlock,
    STRANDSCOPE_OT_rig_jog,
    STRANDSCOPE_OT_rig_go,
    STRANDSCOPE_OT_rig_stop,
    STRANDSCOPE_OT_rig_live,
    STRANDSCOPE_OT_rig_picture,
    STRANDSCOPE_OT_rig_mark,
    STRANDSCOPE_OT_rig_start,
    STRANDSCOPE_OT_rig_order,
    STRANDSCOPE_OT_rig_repeat,
    STRANDSCOPE_OT_rig_dismiss,
)


def register():
    bpy.app.timers.register(catch_up, first_interval=1.0, persistent=True)


def unregister():
    if bpy.app.timers.is_registered(catch_up):
        bpy.app.timers.unregister(catch_up)
    rig.release()
