// The part of ONNX Runtime's C interface that hosts/cpp/host.cpp uses, for tests where the real header is not installed: the
// Python wheel has the library and no header. The real one is in every release archive of ONNX Runtime. Places are those of
// version 1 of the table. The library may append to the table but keeps them, and hands out any version from 1 on.
#pragma once
#include <cstddef>
#include <cstdint>

#define ORT_API_VERSION 1
#define ORT_LOGGING_LEVEL_WARNING 2
#define OrtArenaAllocator 1
#define OrtMemTypeDefault 0
#define ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT 1

struct OrtEnv;
struct OrtStatus;
struct OrtSessionOptions;
struct OrtSession;
struct OrtMemoryInfo;
struct OrtValue;

struct OrtApi {
  void* from_0[2];
  const char* (*GetErrorMessage)(const OrtStatus*);
  OrtStatus* (*CreateEnv)(int, const char*, OrtEnv**);
  void* from_4[3];
  OrtStatus* (*CreateSession)(const OrtEnv*, const char*, const OrtSessionOptions*, OrtSession**);
  void* from_8[1];
  OrtStatus* (*Run)(OrtSession*, const void*, const char* const*, const OrtValue* const*, size_t, const char* const*, size_t,
                    OrtValue**);
  OrtStatus* (*CreateSessionOptions)(OrtSessionOptions**);
  void* from_11[13];
  OrtStatus* (*SetIntraOpNumThreads)(OrtSessionOptions*, int);
  void* from_25[24];
  OrtStatus* (*CreateTensorWithDataAsOrtValue)(const OrtMemoryInfo*, void*, size_t, const int64_t*, size_t, int, OrtValue**);
  void* from_50[19];
  OrtStatus* (*CreateCpuMemoryInfo)(int, int, OrtMemoryInfo**);
};
static_assert(offsetof(OrtApi, CreateCpuMemoryInfo) == 69 * sizeof(void*), "its place in version 1");

struct OrtApiBase {
  const OrtApi* (*GetApi)(uint32_t);
  const char* (*GetVersionString)();
};
extern "C" const OrtApiBase* OrtGetApiBase();
