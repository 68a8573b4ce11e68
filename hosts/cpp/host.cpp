// Play an exported garment over a motion: what an engine does every frame, in C++ with ONNX Runtime's C interface alone.
//
//     ncs export runs/tshirt --out tshirt.onnx
//     g++ -std=c++17 -O2 hosts/cpp/host.cpp -I ORT/include -L ORT/lib -lonnxruntime -Wl,-rpath,ORT/lib -o host
//     ./host tshirt.onnx motion.f32 vertices.f32 [ALPHA]
//
// ORT is a release of ONNX Runtime, unpacked. Both files hold this machine's float32 numbers and nothing else, frame by frame:
//
//     motion.f32    rotations (joints, 3, 3) by rows of the joints that tshirt.onnx.json lists, translation (3,) in metres
//     vertices.f32  vertices (vertices, 3) in metres, in the order of the garment's own file
//
// The motion has the frame rate of tshirt.onnx.json. ALPHA: 0 is static, 1 as trained.
#include <onnxruntime_c_api.h>

#include <chrono>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

using Error = std::runtime_error;
using Shape = std::vector<int64_t>;
const OrtApi* ort = OrtGetApiBase()->GetApi(ORT_API_VERSION);  // null where the library is older than the header

void check(OrtStatus* status) {
  if (status) throw Error(ort->GetErrorMessage(status));
}

// Return the numbers of the list that these keys lead to. An engine has a JSON reader of its own.
Shape list(const std::string& facts, std::initializer_list<const char*> keys) {
  size_t at = 0;
  for (std::string key : keys)
    if ((at = facts.find('"' + key + "\":", at)) == std::string::npos) throw Error("the facts lack " + key);
  Shape numbers;
  std::istringstream rest(facts.substr(facts.find('[', at) + 1));
  char comma = ',';
  for (int64_t number; comma == ',' && rest >> number >> comma;) numbers.push_back(number);
  return numbers;
}

struct Tensor {  // an array of this program's that the runtime reads or writes in place
  std::vector<float> values;
  OrtValue* value;
  Tensor(const OrtMemoryInfo* memory, const Shape& shape) {
    size_t size = 1;
    for (int64_t n : shape) size *= size_t(n);
    values.resize(size);  // zeros
    check(ort->CreateTensorWithDataAsOrtValue(memory, values.data(), bytes(), shape.data(), shape.size(),
                                              ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, &value));
  }
  size_t bytes() const { return values.size() * sizeof(float); }
};

void play(const std::string& model, const std::string& motion, const std::string& out, const char* alpha) {
  if (!ort) throw Error("this ONNX Runtime is older than the header");
  std::ifstream side(model + ".json"), frames(motion, std::ios::binary);
  if (!side || !frames) throw Error((side ? motion : model + ".json") + ": cannot be read");
  const std::string facts{std::istreambuf_iterator<char>(side), {}};
  if (facts.find("\"interface\": 1,") == std::string::npos) throw Error(model + ".json: interface 1 expected");
  OrtEnv* env; OrtSessionOptions* options; OrtSession* session; OrtMemoryInfo* memory;  // they live as long as the program
  check(ort->CreateEnv(ORT_LOGGING_LEVEL_WARNING, "garment", &env));
  check(ort->CreateSessionOptions(&options));
  check(ort->SetIntraOpNumThreads(options, 1));
  check(ort->CreateSession(env, std::filesystem::path(model).c_str(), options, &session));
  check(ort->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &memory));
  const auto input = [&](const char* name) { return list(facts, {"inputs", name, "shape"}); };
  Tensor state(memory, input("state")), next(memory, input("state")), strength(memory, input("alpha"));
  Tensor rotations(memory, input("rotations")), translation(memory, input("translation"));
  Tensor vertices(memory, list(facts, {"outputs", "vertices", "shape"}));
  char* end;
  strength.values[0] = std::strtof(alpha, &end);
  const size_t total = std::filesystem::file_size(motion), frame = rotations.bytes() + translation.bytes();
  if (end == alpha || *end) throw Error(std::string(alpha) + ": a number expected for ALPHA");
  if (!total || total % frame) throw Error(motion + ": frames of " + std::to_string(frame) + " bytes expected");
  std::ofstream file(out, std::ios::binary);
  const auto start = std::chrono::steady_clock::now();
  for (size_t i = 0; i < total / frame; ++i) {
    frames.read((char*)rotations.values.data(), rotations.bytes()).read((char*)translation.values.data(), translation.bytes());
    const char *inputs[] = {"state", "rotations", "translation", "alpha"}, *outputs[] = {"next_state", "vertices"};
    const OrtValue* given[] = {state.value, rotations.value, translation.value, strength.value};
    OrtValue* made[] = {next.value, vertices.value};
    check(ort->Run(session, nullptr, inputs, given, 4, outputs, 2, made));
    std::swap(state.value, next.value);  // the state goes into the next frame; at the start it is zeros
    if (!file.write((const char*)vertices.values.data(), vertices.bytes())) throw Error(out + ": cannot be written");
  }
  const std::chrono::duration<double, std::milli> each = (std::chrono::steady_clock::now() - start) / double(total / frame);
  std::printf("%zu frames of %zu vertices, %.2g ms each\n", total / frame, vertices.values.size() / 3, each.count());
}

int main(int count, char** words) try {
  if (count != 4 && count != 5) throw Error("usage: host MODEL.onnx MOTION.f32 VERTICES.f32 [ALPHA]");
  play(words[1], words[2], words[3], count == 5 ? words[4] : "1");
} catch (const std::exception& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 1;
}
