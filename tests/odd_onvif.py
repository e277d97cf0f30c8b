"""An ONVIF device on loopback that gives canned replies, written against the wire."""

import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from torchptz.cameras import Credentials, open_camera

SPACES = "http://www.onvif.org/ver10/tptz"
GENERIC = f"{SPACES}/PanTiltSpaces/PositionGenericSpace"
DEGREES = f"{SPACES}/PanTiltSpaces/SphericalPositionSpaceDegrees"
ZOOM = f"{SPACES}/ZoomSpaces/PositionGenericSpace"
UTC = "<tt:UtcTime>2014-12-29T20:01:31Z</tt:UtcTime>"
PTZ = '<tt:PTZConfiguration token="c"><tt:NodeToken>n</tt:NodeToken></tt:PTZConfiguration>'
PROFILE = '<trt:Profiles token="{}"><tt:Name>{}</tt:Name>{}</trt:Profiles>'


def service(namespace, path, host="{host}"):
    return (
        f"<tds:Service><tds:Namespace>http://www.onvif.org/{namespace}/wsdl</tds:Namespace>"
        f"<tds:XAddr>http://{host}{path}</tds:XAddr></tds:Service>"
    )


def space(uri, x, y=None, name="AbsolutePanTiltPositionSpace"):
    ranges = [("X", x)] + ([("Y", y)] if y else [])
    return (
        f"<tt:{name}><tt:URI>{uri}</tt:URI>"
        + "".join(
            f"<tt:{axis}Range><tt:Min>{low}</tt:Min><tt:Max>{high}</tt:Max></tt:{axis}Range>"
            for axis, (low, high) in ranges
        )
        + f"</tt:{name}>"
    )


def zoom_space(high=1):
    return space(ZOOM, (0, high), name="AbsoluteZoomPositionSpace")


def spaces(*declared):
    content = f"<tt:Spaces>{''.join(declared)}</tt:Spaces>"
    return f"<tptz:PTZConfigurationOptions>{content}</tptz:PTZConfigurationOptions>"


def status(
    pan_tilt, zoom='x="0.25"', move="<tt:MoveStatus><tt:PanTilt>IDLE</tt:PanTilt></tt:MoveStatus>"
):
    position = f"<tt:Position><tt:PanTilt {pan_tilt}/><tt:Zoom {zoom}/></tt:Position>"
    return f"<tptz:PTZStatus>{position}{move}{UTC}</tptz:PTZStatus>"


def fault(*codes, reason="no"):
    inner = ""
    for code in reversed(codes):
        inner = f"<s:Subcode><s:Value>ter:{code}</s:Value>{inner}</s:Subcode>"
    return (
        f"<s:Fault><s:Code><s:Value>s:Sender</s:Value>{inner}</s:Code>"
        f"<s:Reason><s:Text>{reason}</s:Text></s:Reason></s:Fault>"
    )


class OddDevice:
    """Answers each operation with what stands in `answers`: the content of a response, (status,
    Fault or bytes), or a function from the request's text to one of those. Keeps the requests."""

    def __init__(self):
        device = self
        self.requests = []
        self.answers = {
            "GetServices": service("ver10/media", "/m")
            + service("ver20/ptz", "/p")
            + service("ver20/imaging", "/i"),
            "GetProfiles": PROFILE.format("main", "Main", PTZ),
            "GetSnapshotUri": "<trt:MediaUri><tt:Uri>http://{host}/snap?a=1&amp;b=2</tt:Uri></trt:MediaUri>",
            "GetConfigurationOptions": spaces(space(DEGREES, (-170, 170), (-90, 20)), zoom_space()),
            "GetStatus": status(f'x="10.5" y="-5.25" space="{DEGREES}"'),
            "AbsoluteMove": "",
        }

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                text = self.rfile.read(int(self.headers["Content-Length"])).decode()
                operation = re.search(r"<s:Body><\w+:(\w+)", text)[1]
                device.requests.append((operation, self.path, text))
                answer = device.answers.get(operation, (500, fault("ActionNotSupported")))
                answer = answer(text) if callable(answer) else answer
                code, body = answer if isinstance(answer, tuple) else (200, None)
                if body is None:
                    body = f"<x:{operation}Response>{answer}</x:{operation}Response>"
                if isinstance(body, str):
                    body = device.envelope(body).encode()
                self.send_response(code)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *args):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def envelope(self, body):
        names = " ".join(f'xmlns:{p}="urn:{p}"' for p in ("tds", "trt", "tptz", "tt", "x", "ter"))
        body = body.replace("{host}", self.address)
        return f'<s:Envelope xmlns:s="urn:any" {names}><s:Body>{body}</s:Body></s:Envelope>'

    def sent(self, operation):
        return [text for name, _, text in self.requests if name == operation]

    def open(self, **options):
        credentials = Credentials("admin", "secret")
        options = {"connect_timeout_s": 1, "read_timeout_s": 2, **options}
        return open_camera("onvif", "odd", self.address, credentials, **options)

    def stop(self):
        self._server.shutdown()
        self._server.server_close()
